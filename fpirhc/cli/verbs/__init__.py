"""The commands, one file each: every module of this package has its command in `VERB`."""
