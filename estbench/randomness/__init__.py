"""Random numbers by run and purpose: streams of a run, and counter-based ones by key."""
