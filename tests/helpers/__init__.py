"""Plants, loops, faults and rules that several tests use."""
