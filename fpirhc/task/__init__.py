"""Control tasks: problem, reference, limits, disturbances, dead time."""
