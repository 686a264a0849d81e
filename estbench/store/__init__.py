"""Results on disk: the zarr store, what it declares, its locks and versions."""
