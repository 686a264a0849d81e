"""Statistics of an estimator's consistency: NEES, NIS, coverage, whiteness, the verdict."""
