"""Symbols and the one door through which numbers meet CasADi."""
