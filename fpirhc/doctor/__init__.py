"""The parts of an installation, and whether they work."""
