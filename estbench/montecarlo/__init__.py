"""Many runs: their batches, the workers that compute them, and the results."""
