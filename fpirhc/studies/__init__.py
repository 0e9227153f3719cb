"""Studies: what a user asks of several runs."""
