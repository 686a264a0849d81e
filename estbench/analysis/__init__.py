"""Comparison of estimators from stores, and the leaderboard: `estbench compare`, `reproduce`."""
