"""The horizon: its cost, its discretised model, and the gradient of its auxiliary function."""
