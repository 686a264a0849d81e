"""Estimators, one algorithm per file, behind the protocol of `estbench.estimators.protocol`."""
