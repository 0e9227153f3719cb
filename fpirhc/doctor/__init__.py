"""What an installation has, and whether it works."""
