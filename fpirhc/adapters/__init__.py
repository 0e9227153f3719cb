"""Simulators and hardware of others as realities, one file per package; the packages are those of the extra `fpirhc[outside]`."""
