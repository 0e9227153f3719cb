"""Rules by which an adaptive controller moves its parameters."""
