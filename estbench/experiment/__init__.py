"""A scenario as objects: models, sensors, schedule, noise, priors."""
