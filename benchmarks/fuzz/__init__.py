"""Seeded hostile inputs: scenarios, MJCFs, controls, calls, damaged stores; see `__main__`."""
