"""What a controller is asked to do: problem, reference, limits, disturbances, dead time."""
