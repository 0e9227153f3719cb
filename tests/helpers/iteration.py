"""Deformations alone: one scalar iteration with its memory, and how fast it goes when its pairs are late."""

from typing import Any

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.contracts import Deformation


def affine(effective_gain: float) -> fp.Affine:
    """r+ = r - a (f - d)."""
    return fp.Affine(gain=-1.0).with_effective_gain(effective_gain)


class Scalar:
    """A map of one coordinate with its memory, cycle by cycle."""

    def __init__(self, deformation: Deformation) -> None:
        self.layout = deformation.memory(("q",))
        r, f, d, m = (ca.SX.sym(n, k) for n, k in zip("rfdm", (1, 1, 1, self.layout.size), strict=True))
        request, following = deformation.step(r, f, d, self.layout.split(m))
        self.step = ca.Function("step", [r, f, d, m], [ca.densify(request), ca.densify(self.layout.join(following))])
        self.memory: Any = self.layout.start()

    def __call__(self, request: float, response: float, desired: float) -> float:
        after, self.memory = self.step(request, response, desired, self.memory)
        return float(after)


def iteration_radius(deformation: Deformation, delay: int) -> float:
    """Spectral radius of the scalar iteration whose response is the request of `delay` cycles earlier."""
    believed = round(deformation.form.late) if deformation.form.modelled else 0
    layout, size = deformation.memory(("q",)), max(delay, believed) + 1  # requests on their way, newest first
    z = ca.SX.sym("z", size + layout.size)
    memory = layout.split(z[size:])
    request, following = deformation.step(z[believed], z[delay], ca.SX(0), memory)
    on = ca.vertcat(request, z[: size - 1]) if size > 1 else request
    function = ca.Function("one", [z], [ca.jacobian(ca.vertcat(on, layout.join(following)), z)])
    start = layout.start()
    if "queue_filled" in layout.names:
        start[layout.slice("queue_filled")] = 1e6
    return float(np.abs(np.linalg.eigvals(function(np.r_[np.zeros(size), start]).full())).max())
