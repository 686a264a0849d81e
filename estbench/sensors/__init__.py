"""Sensors: noise, imperfections, sampling times and latency of the readings."""
