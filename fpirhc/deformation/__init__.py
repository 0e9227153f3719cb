"""Deformations: fixed-point maps that make the plant respond as desired although the model is wrong."""

from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.identity import Identity
from fpirhc.deformation.leaky import leaky_margin, leaky_pole
from fpirhc.deformation.model_referenced import ModelReferenced
from fpirhc.deformation.rfpt import RFPT
from fpirhc.deformation.rfpt_vector import RFPTVector
from fpirhc.deformation.rotation import Rotation
from fpirhc.deformation.sigmoid import Sigmoid
from fpirhc.deformation.wrappers.base import Wrapper
from fpirhc.deformation.wrappers.damped import Damped
from fpirhc.deformation.wrappers.delayed import Increment, Paired
from fpirhc.deformation.wrappers.filtered import Filtered
from fpirhc.deformation.wrappers.guarded import Guarded
from fpirhc.deformation.wrappers.self_paired import DelayWatched, SelfPaired
from fpirhc.deformation.wrappers.tuned import Tuned

__all__ = [
    "RFPT",
    "Affine",
    "Damped",
    "Deformation",
    "DelayWatched",
    "Filtered",
    "Guarded",
    "Identity",
    "Increment",
    "ModelReferenced",
    "Paired",
    "RFPTVector",
    "Rotation",
    "SelfPaired",
    "Sigmoid",
    "Tuned",
    "Wrapper",
    "leaky_margin",
    "leaky_pole",
]
