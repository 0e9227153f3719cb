"""Horizons: cost, discretised model, limits, and the gradient of the auxiliary function."""
