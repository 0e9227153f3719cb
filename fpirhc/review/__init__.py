"""Questions that the symbols, the two parameter sets and the settings answer before a run."""
