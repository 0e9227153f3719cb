"""Observers: one file per way to know states that no sensor shows."""
