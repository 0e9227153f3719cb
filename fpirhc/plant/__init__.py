"""Plants: states, inputs, parameters, the response and its inverse; integrators."""
