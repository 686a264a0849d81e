"""Tuning: what a filter should believe, by likelihood or by error, proved on held-out runs."""
