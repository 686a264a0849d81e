"""Recorded logs of robots: their columns, clocks and readings, and estimators on them."""
