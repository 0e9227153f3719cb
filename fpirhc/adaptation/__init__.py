"""Adaptation rules: how estimated parameters follow from what a controller sees."""
