"""Optimisers: each turns a horizon's standard form into one step that improves a plan."""
