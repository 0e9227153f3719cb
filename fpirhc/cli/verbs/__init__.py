"""The commands, one file each: a module here is found by a scan and holds its command in `VERB`."""
