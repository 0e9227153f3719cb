"""The closed loop's own linearisation: its step is run and differentiated, and nothing is modelled beside it."""
