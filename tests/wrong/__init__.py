"""Members as somebody else might write them: one right member of a family, and wrong ones that differ from it in one thing."""
