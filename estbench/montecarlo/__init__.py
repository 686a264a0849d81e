"""Monte Carlo experiments: batches of runs, workers that compute them, results."""
