"""Closed loops: composed, run, measured."""
