"""`follow` at the address that scripts of version 0.1 name; it is `estbench.follow`."""

from estbench.inference.offline import follow

__all__ = ["follow"]
