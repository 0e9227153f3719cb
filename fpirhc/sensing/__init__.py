"""Sensing: the way from the plant to the controller, through sensors and an estimator of unmeasured quantities."""
