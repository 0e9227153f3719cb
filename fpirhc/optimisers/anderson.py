"""Anderson acceleration of a fixed-point iteration x <- T(x), safeguarded. Theory: docs/theory-plants.md."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fpirhc.fields.checked import Checked
from fpirhc.fields.kinds import Few
from fpirhc.horizon.riccati import solve_free
from fpirhc.symbolic.expression import is_finite

_RIDGE = 1e-12  # of the normal equations with columns of length one
_GROWTH = 2.0  # growth of |F| after which the memory is dropped


@dataclass(frozen=True)
class Anderson(Checked):
    """Acceleration with the last changes of an iteration.

    Args:
        memory: number of changes; 3 to 10 are usual.

    Raises:
        InvalidValue: fewer than one.
    """

    memory: Few


def iterated(
    function: ca.Function, start: ca.MX, arguments: list[ca.MX], iterations: int, acceleration: Anderson | None
) -> ca.MX:
    """Return the column x after a number of steps x <- function(x, *arguments). `acceleration`: None: plain steps."""
    x = ca.vec(start)
    if acceleration is None:
        for _ in range(iterations):
            x = function(x, *arguments)
        return x
    advance = _advance(function, acceleration.memory)
    size = start.numel()
    state = ca.vertcat(x, ca.MX.zeros(2 * size + 2 * size * acceleration.memory + 1))
    for _ in range(iterations):
        state = advance(state, *arguments)
    return state[:size]


def _advance(function: ca.Function, memory: int) -> ca.Function:
    """Function (state, *arguments) -> state, with state = (x, T before, F before, dF, dT, number of changes known)."""
    size = function.numel_in(0)
    state = ca.MX.sym("state", 3 * size + 2 * size * memory + 1)
    arguments = [ca.MX.sym(function.name_in(k), *function.size_in(k)) for k in range(1, function.n_in())]
    ends = [0, size, 2 * size, 3 * size, (3 + memory) * size, (3 + 2 * memory) * size, state.numel()]
    x, image_before, error_before, errors, images, known = ca.vertsplit(state, ends)
    errors, images = ca.reshape(errors, size, memory), ca.reshape(images, size, memory)
    image = function(x, *arguments)
    error = image - x
    bad = ca.logic_not(ca.norm_2(error) <= _GROWTH * ca.norm_2(error_before))  # NaN is bad
    tripped = ca.logic_and(known >= 2, bad)
    first = known < 1
    recorded_errors = ca.horzcat(error - error_before, errors[:, : memory - 1])
    recorded_images = ca.horzcat(image - image_before, images[:, : memory - 1])
    errors = ca.if_else(ca.logic_or(first, tripped), 0, recorded_errors)
    images = ca.if_else(ca.logic_or(first, tripped), 0, recorded_images)
    weights = _least_squares(memory)(ca.mtimes(errors.T, errors), ca.mtimes(errors.T, error))
    wanted = image - ca.mtimes(images, weights)
    usable = is_finite(wanted)
    next_x = ca.if_else(tripped, image_before, ca.if_else(ca.logic_and(usable, ca.logic_not(first)), wanted, image))
    last_image, last_error = ca.if_else(tripped, image_before, image), ca.if_else(tripped, error_before, error)
    count = ca.if_else(tripped, 0, known + 1)
    result = ca.vertcat(next_x, last_image, last_error, ca.vec(errors), ca.vec(images), count)
    return ca.Function("fpirhc_anderson", [state, *arguments], [result])


def _least_squares(memory: int) -> ca.Function:
    """Function (dF'dF, dF'F) -> gamma; columns not filled yet are zero and get no weight."""
    gram, right = ca.SX.sym("gram", memory, memory), ca.SX.sym("right", memory)
    filled = ca.diag(gram) > 0
    size = ca.sqrt(ca.if_else(filled, ca.diag(gram), 1))
    correlations = gram / (size @ size.T) + _RIDGE * ca.SX.eye(memory)
    weights = solve_free(correlations, filled, right / size) / size
    return ca.Function("fpirhc_anderson_weights", [gram, right], [weights])
