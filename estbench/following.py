"""`follow` at the address that scripts of version 0.1 name; `estbench.follow` is the same function."""

from estbench.inference.offline import follow

__all__ = ["follow"]
