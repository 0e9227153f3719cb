"""One turn of the iteration with limits, as expressions: one file for each of its parts."""
