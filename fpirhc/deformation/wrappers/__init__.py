"""Deformations around a deformation: pairing under dead time, filters, gains that change on line."""
