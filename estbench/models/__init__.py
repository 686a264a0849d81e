"""State-space models: the protocol, linear and function models, and MuJoCo."""
