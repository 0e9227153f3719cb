"""Many drawn plants, paired between controllers."""
