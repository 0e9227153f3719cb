"""One input for several coordinates in turn: time slots."""
