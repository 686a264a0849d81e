"""Statistics of many runs, from arrays or from stores: `estbench compare` and `reproduce`."""
