"""Controllers: blocks from a measurement to a command."""
