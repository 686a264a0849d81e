"""The scenario file: its sections, how it is read, and its mistakes in words."""
