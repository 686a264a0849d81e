"""Results on disk: the zarr store, its arrays, its locks and its versions."""
