"""Several controllers on one problem."""
