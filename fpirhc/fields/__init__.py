"""Fields of values are checked where they are given: types, ranges, names."""
