"""Estimates from the measurements of a whole run: RTS, unscented RTS, and batch MAP."""
