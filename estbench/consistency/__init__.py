"""Can the covariance be trusted: NEES, NIS, coverage, whiteness, and the verdict."""
