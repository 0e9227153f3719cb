"""Whether the equations of algebraic states are well written, and determine them at a point."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from fpirhc.errors import FpirhcError, Mistakes
from fpirhc.fields.user_code import called, named_results
from fpirhc.plant.algebraic import Algebraic
from fpirhc.plant.motion import Motion, arguments_of
from fpirhc.symbolic.layout import Named

SINGULAR = 1e-12  # ratio of the least to the largest singular value of dg/dz


def check_algebraic(plant: Motion, algebraic: Algebraic, views: tuple[Named, ...], mistakes: Mistakes) -> None:
    """Add every mistake in the names, the guess and the equations to `mistakes`."""
    others = [*plant.state.elements, *plant.inputs, *plant.parameters]
    for name in algebraic.names:
        if not str(name).isidentifier() or name in others:
            mistakes.add(
                f"algebraic: '{name}' is no name of its own; use letters, digits and underscores, and no other name twice"
            )
    if not algebraic.names:
        mistakes.add("algebraic: units are empty; name at least one algebraic state, with its unit")
    z = ca.SX.sym("z", max(1, len(algebraic.names)))
    parts: dict[str, Callable[[], object]] = {
        "equations": lambda: called("algebraic", algebraic.equations, *views, algebraic.view(z)),
        "guess": lambda: (
            called("algebraic: guess", algebraic.guess, *views) if callable(algebraic.guess) else algebraic.guess
        ),
    }
    for what, part in parts.items():
        try:
            values = named_results(f"algebraic: {what}", part())
        except FpirhcError as error:
            mistakes.add(str(error))
            continue
        mistakes.unknown(f"algebraic: {what}: algebraic state", values, algebraic.names)
        for name in algebraic.names:
            if name not in values:
                mistakes.add(f"algebraic: {what} have nothing for '{name}'; add it")
    if mistakes.none:
        try:
            algebraic.residual(views, z)
            algebraic.first(views)
        except FpirhcError as error:
            mistakes.add(str(error))


def unsolved(plant: Motion, state: np.ndarray, command: np.ndarray, parameters: np.ndarray) -> str:
    """Return why the algebraic states cannot be computed at a point; empty where they can, and without any.

    Args:
        plant: the plant.
        state: shape (nx,).
        command: shape (nu,).
        parameters: shape (np,).
    """
    algebraic = plant.algebraic
    if algebraic is None:
        return ""
    names = ", ".join(algebraic.names)
    solution = np.asarray(plant.equations.algebraic(state, command, parameters).full()).ravel()
    x, u, p = plant.symbols()
    z = ca.SX.sym("z", len(algebraic.names))
    slope = ca.jacobian(algebraic.residual(arguments_of(plant, x, u, p), z), z)
    first = algebraic.first(arguments_of(plant, x, u, p))
    at_guess = np.asarray(ca.Function("fpirhc_guess", [x, u, p], [first])(state, command, parameters).full()).ravel()
    at = np.where(np.isfinite(solution), solution, at_guess)
    values = np.asarray(
        ca.Function("fpirhc_regular", [x, u, p, z], [ca.densify(slope)])(state, command, parameters, at).full()
    )
    if not np.isfinite(values).all():
        return f"the slopes of the equations of {names} are not finite; choose another guess"
    sizes = np.linalg.svd(values / np.maximum(np.abs(values).max(axis=1, keepdims=True), 1e-300), compute_uv=False)
    if sizes[-1] <= SINGULAR * sizes[0]:
        return (
            f"the equations of {names} do not determine them: their slopes are singular (index above 1); differentiate them, "
            "or make one of them a coordinate"
        )
    if not np.isfinite(solution).all():
        return (
            f"Newton's method does not arrive at {names} in {algebraic.steps} steps; give a nearer guess, or more steps"
        )
    return ""
