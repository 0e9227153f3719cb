"""Numbers that sum up a run: one value per metric, found by discovery, measured in one place.

A file of this folder that defines `METRICS`, a tuple of `Metric`, adds them; so does an entry point of the group
`fpirhc.metrics` of another package, and `metrics = (...)` in a problem file.
"""
