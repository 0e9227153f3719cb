"""The targets, one file each: a value `TARGET` of the class `fpirhc.export.device.Target`."""
