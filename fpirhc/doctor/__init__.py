"""What an installation has, and whether known traps of the libraries below are closed here."""
