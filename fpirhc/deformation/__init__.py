"""Deformations: fixed-point maps that make the plant respond as desired although the model is wrong."""

from fpirhc.deformation.affine import Affine
from fpirhc.deformation.base import Deformation
from fpirhc.deformation.blended import Blended
from fpirhc.deformation.damped import Damped
from fpirhc.deformation.delayed import Increment, Paired
from fpirhc.deformation.filtered import Filtered
from fpirhc.deformation.guarded import Guarded
from fpirhc.deformation.identity import Identity
from fpirhc.deformation.rfpt import Rfpt
from fpirhc.deformation.rfpt_vector import RfptVector
from fpirhc.deformation.rotation import Rotation
from fpirhc.deformation.self_paired import DelayWatched, SelfPaired
from fpirhc.deformation.sigmoid import Sigmoid
from fpirhc.deformation.tuned import Tuned
from fpirhc.deformation.wrapper import Wrapper

__all__ = [
    "Affine",
    "Blended",
    "Damped",
    "Deformation",
    "DelayWatched",
    "Filtered",
    "Guarded",
    "Identity",
    "Increment",
    "Paired",
    "Rfpt",
    "RfptVector",
    "Rotation",
    "SelfPaired",
    "Sigmoid",
    "Tuned",
    "Wrapper",
]
