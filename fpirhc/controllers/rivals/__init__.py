"""Controllers from the literature to compare with."""
