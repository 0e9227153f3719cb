"""Baselines: fresh results are compared with committed ones, and every change of a baseline is asked for with a reason."""
