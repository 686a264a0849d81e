"""Spaces of states and readings: manifolds, rotations, batched linear algebra."""
