"""The first files of a problem of one's own."""
