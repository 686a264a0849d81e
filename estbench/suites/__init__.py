"""What a suite of sensors shows: observability along a motion, and the design of a suite."""
