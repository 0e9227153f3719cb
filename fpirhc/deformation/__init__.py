"""Deformations: fixed-point maps that make the plant respond as desired although the model is wrong."""

from fpirhc.deformation.base import Deformation, Identity

__all__ = ["Deformation", "Identity"]
