"""Settings found by search, with the same budget for every controller."""
