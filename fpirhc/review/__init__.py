"""Questions asked before a run: what the symbols, the two parameter sets and the settings already tell."""
