"""The step of a stepper, out of Python: a folder of files for each target. All stand on `Stepper.function` and its layouts."""
