"""Studies: variants of one scenario on common random numbers, which share truth where they may."""
