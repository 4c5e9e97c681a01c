"""Studies: the same work over many settings, arms or durations, on this machine's processors or a Dask cluster."""
