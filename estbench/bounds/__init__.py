"""How good an estimator could be: the posterior Cramér-Rao bound of a model or a scenario."""
