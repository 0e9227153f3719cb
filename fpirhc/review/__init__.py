"""A review: what runs of a loop, pushed a little, say of it before it is trusted."""
