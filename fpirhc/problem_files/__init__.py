"""Problem files: loaded, checked, and changed by settings."""
