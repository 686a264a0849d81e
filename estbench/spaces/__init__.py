"""The spaces that states and readings live in: manifolds, rotations, small batched matrices."""
