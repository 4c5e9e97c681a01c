"""Studies: the same work over many settings, arms or durations, on this machine's processors or a Dask cluster.

`studies.py` holds them in one table. Every study is over one kind of case (`case.py`), and `workers.py` does the work.
"""
