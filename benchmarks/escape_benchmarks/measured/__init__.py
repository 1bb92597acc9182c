"""Real calibration data: readers of folders that are next to the project, with their ``README.md``.

Scripts that evaluate the data are in benchmarks/studies.
"""
