"""Estimators of model parameters."""
