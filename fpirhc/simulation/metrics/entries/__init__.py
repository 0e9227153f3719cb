"""Shipped metrics: a file of this folder that defines `METRICS`, a tuple of `Metric`, adds them; none imports another."""
