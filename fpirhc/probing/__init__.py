"""A probe of a plant that nobody knows: what its response is made of, and the adaptation that suits it."""
