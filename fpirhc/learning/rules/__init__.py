"""Rules by which an adaptive controller changes its parameters."""
