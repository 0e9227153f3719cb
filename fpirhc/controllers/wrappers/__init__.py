"""Controllers around a controller."""
