"""A first scenario for a robot of which only the MJCF is known, as a commented file."""
