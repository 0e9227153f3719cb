"""Attacks on loops, files and processes: what a machine must survive."""
