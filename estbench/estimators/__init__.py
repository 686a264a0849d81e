"""Estimators, one algorithm a file, behind the protocol of `estbench.estimators.protocol`."""
