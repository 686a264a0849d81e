"""Error budgets: how much of an estimator's error each source causes."""
