"""An estimator on readings as they arrive: the event loop, late readings, innovations."""
