"""The outputs at the time when a command will act: the model's at the predicted state, and the distance of the measured ones.

    y^(k)(t + tau) = h_k(x(t + tau), p) + sum_{j >= k} d^(j)(t) tau^(j-k) / (j-k)!,      d^(j) = y^(j) - h_j(x, p),   j < r,

where d^(r) is taken as zero: over a dead time, which is short. Over a horizon it is not, see `consistent_state`.
"""

from __future__ import annotations

import math

import casadi as ca

from fpirhc.plant.plant import Plant


def output_ahead(plant: Plant) -> ca.Function:
    """Return the Function (measured outputs, state, state ahead, parameters, time ahead) -> outputs ahead.

    Args:
        plant: the model, with outputs.
    """
    x, u, p = plant.symbols()
    later, y, time = ca.SX.sym("later", x.numel()), ca.SX.sym("y", plant.output.size), ca.SX.sym("time")
    held = ca.SX.zeros(u.numel()), p, ca.SX.zeros(len(plant.names))
    distance, ahead = y - plant.output_function(x, *held), plant.output_function(later, *held)
    elements, entries = plant.output.elements, []
    for k, element in enumerate(elements):
        higher = [i for i, e in enumerate(elements) if e.startswith(element) and not e[len(element) :].strip("'")]
        powers = [elements[i].count("'") - element.count("'") for i in higher]
        terms = (distance[i] * time**n / math.factorial(n) for i, n in zip(higher, powers, strict=True))
        entries.append(sum(terms, start=ahead[k]))
    return ca.Function("fpirhc_output_ahead", [y, x, later, p, time], [ca.densify(ca.vertcat(*entries))])
