"""Estimators of what a model gets wrong: disturbances and parameters, from what was commanded and measured."""
