"""Questions of a review, one per file, found by discovery."""
