"""Baselines: fresh results are compared with committed ones, and every change of a baseline needs a reason."""
