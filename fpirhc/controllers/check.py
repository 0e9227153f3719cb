"""Checks a controller against its problem before a run, and refuses a deformation that cannot converge.

Where eigenvalues of the response Jacobian at the start have real parts of both signs, no gain converges. Where they have one sign,
gains of the other sign enlarge every error, and a delay of the response lowers the largest one that converges.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np

from fpirhc.contraction.delayed import converges, delayed, largest_gain
from fpirhc.contraction.spectrum import Spectrum, assess_gain, jacobians_along, linear_limit
from fpirhc.controllers.contract import Controller, resolved
from fpirhc.controllers.seeing import check_believed
from fpirhc.deformation.base import Deformation, against_wrappers, own_gain, with_its_gain
from fpirhc.deformation.wrappers.delayed import Paired
from fpirhc.errors import NotContractive, refuse
from fpirhc.symbolic.evaluate import Latest
from fpirhc.task.dead_time import every
from fpirhc.task.problem import Problem

_NOTHING = 1e-12  # largest eigenvalue of a Jacobian that has no effect


@contextmanager
def any_gain() -> Iterator[None]:
    """Within it no gain is refused: a review asks loops that no run would begin."""
    token = _REFUSES.set(False)
    try:
        yield
    finally:
        _REFUSES.reset(token)


_REFUSES = ContextVar("fpirhc_refuses_gains", default=True)


def check_gain_sign(problem: Problem, deformation: Deformation) -> None:
    """Raise if the deformation cannot converge from the start of the problem."""
    gain = deformation.effective_gain()
    if gain == 0 or not _REFUSES.get():
        return
    spectrum = _at_start(problem, deformation)
    if spectrum is not None and sum(linear_limit(spectrum.eigenvalues)) * gain <= 0:
        report = assess_gain(deformation, spectrum, problem.response_delay)
        turned = [n for n, one in problem.plant.parameters.items() if one.approximate * one.exact < 0]
        why = f": {' and '.join(turned)} of the plant and of the model differ in sign" if turned else ""
        raise NotContractive(f"{report.fault}{why}", report.remedy)


def check_gain_size(problem: Problem, deformation: Deformation) -> None:
    """Raise if a gain is beyond the limit of the iteration: that of the plant itself, or behind the delay of estimator and filter.

    The dead time of the problem is added where all inputs have the same. Without estimator dead time is not judged. A map that
    changes its gain on line begins where it likes.
    """
    gain = deformation.effective_gain()
    if gain == 0 or not deformation.form.steady or not _REFUSES.get():
        return
    spectrum, jacobian = _at_start(problem, deformation), _jacobian_at_start(problem)
    seen = _delayed_weights(problem)
    if spectrum is None or (seen is None and abs(gain) < max(map(abs, linear_limit(spectrum.eigenvalues)))):
        return
    weights = seen or [delayed(np.ones(1), deformation.form.late)] * len(jacobian)
    if converges(deformation, jacobian, weights):
        return
    if seen is None and not deformation.memory(problem.plant.controlled_names).size:
        raise _too_large(deformation, spectrum, max(map(abs, linear_limit(spectrum.eigenvalues))))
    largest = largest_gain(deformation, jacobian, weights)
    if seen is None:
        raise _too_large(deformation, spectrum, largest)
    # A window does not see requests that alternate; a fraction of a cycle in the pairing damps them.
    delay = problem.response_delay
    pairs = {d: Paired(deformation, cycles=d) for d in (delay, delay + 0.5, delay - 0.5) if d >= 0}
    usable = {d: one for d, one in pairs.items() if not any(against_wrappers(one))}
    best = next((d for d, one in usable.items() if converges(one, jacobian, weights)), None)
    raise _too_late(problem, deformation, largest, best)


def _delayed_weights(problem: Problem) -> list[np.ndarray] | None:
    """Weights of past requests in every estimated response, dead time included; None where no estimator spreads them."""
    orders = problem.plant.response_orders.values()
    weights = [problem.sensing.estimator.weights(order, problem.period) for order in orders]
    dead_times = {problem.dead_time.inputs.get(name, 0.0) for name in problem.plant.inputs}
    if all(w.size == 1 for w in weights) or len(dead_times) > 1:
        return None
    dead_time = (dead_times.pop() + problem.dead_time.measurement) / problem.period
    return [delayed(w, dead_time) for w in weights]


def _too_large(deformation: Deformation, spectrum: Spectrum, limit: float) -> NotContractive:
    """What is wrong with a gain that is beyond the limit of the plant itself."""
    name = own_gain(deformation)[0]
    largest = max(spectrum.eigenvalues.ravel(), key=abs)
    value_text = f"{largest.real if largest.imag == 0 else largest:.3g}"
    return NotContractive(
        f"{with_its_gain(deformation)} is too large",
        f"use 0 < |{name}| < {_in_own(deformation, limit):.3g}, where the iteration converges: the largest eigenvalue of the "
        f"response Jacobian at the start is {value_text}",
    )


def _too_late(problem: Problem, deformation: Deformation, limit: float, pairing: float | None) -> NotContractive:
    name, estimator = own_gain(deformation)[0], problem.sensing.estimator
    delay, of_estimator = problem.response_delay, problem.sensing.delay(problem.plant, problem.period)
    apart = f"dead time {delay - of_estimator:.4g}, {estimator} {of_estimator:.4g}"
    causes = str(estimator) if delay == of_estimator else apart
    remedies = [f"0 < |{name}| < {_in_own(deformation, limit):.3g}"] if limit else []
    remedies += [f"Paired(map, cycles={pairing:.4g})"] if pairing is not None else []
    remedies += ["a shorter window or time constant"]
    # These remedies stay beside an advice on the gain, because all but the first change something else.
    return NotContractive(
        f"{with_its_gain(deformation)}: the response comes {delay:.4g} cycles late ({causes}), so the iteration "
        f"does not converge with this {name}; what helps: {', or '.join(remedies)}"
    )


def _in_own(deformation: Deformation, limit: float) -> float:
    """The size of the deformation's own gain at an effective gain."""
    return abs(limit / deformation.effective_gain() * own_gain(deformation)[1])


def _at_start(problem: Problem, deformation: Deformation) -> Spectrum | None:
    """Eigenvalues of the response Jacobian at the start, weighted; None where the inverse response is singular there.

    With a reality they are those of the response at the end of a cycle; None where the command has not reached it by then.
    """
    jacobian = _jacobian_at_start(problem)
    if not np.isfinite(jacobian).all():
        return None
    spectrum = Spectrum(np.linalg.eigvals(deformation.form.weighted(jacobian)))
    return spectrum if np.abs(spectrum.eigenvalues).max() > _NOTHING else None


def _jacobian_at_start(problem: Problem) -> np.ndarray:
    return _JACOBIANS.of((problem,), (), lambda: _jacobian(problem.of_equations))


def _jacobian(problem: Problem) -> np.ndarray:
    plant, exact = problem.plant, problem.real_plant.exact[None, :]
    real, state = problem.real_start[None, :], problem.start_state[None, :]
    response = plant.equations.controlled_response(problem.start_state, problem.inputs_before, plant.approximate)
    return jacobians_along(problem, real, state, response.full().T, plant.approximate, exact)[0]


_JACOBIANS: Latest[np.ndarray] = Latest(8)  # a search checks many gains at the same start
_CHECKED: Latest[Controller] = Latest(16)  # a comparison asks for the same controllers again and again


def checked(problem: Problem, controller: Controller, *, numbers_only: bool = False) -> Controller:
    """Return the resolved controller, checked against the problem.

    Args:
        numbers_only: whether only numbers have changed since the last check, so that what is slow to build need not be built again.
    """
    facts = numbers_only, _REFUSES.get()
    return _CHECKED.of((problem, controller), facts, lambda: _checked(problem, controller, numbers_only))


def _checked(problem: Problem, controller: Controller, numbers_only: bool) -> Controller:
    refuse(_of_outputs(problem))
    ready = resolved(problem, controller)
    if numbers_only and ready.inner is None and ready.planner is not None:
        ready.planner.check_weights(problem)
    else:
        ready.check(problem)
    check_form(problem, ready)
    check_believed(problem, ready)
    if ready.deforms not in ("target", "turns"):  # their own checks judge gains
        check_gain_sign(problem, ready.deformation)
        check_gain_size(problem, ready.deformation)
    return ready


def check_form(problem: Problem, controller: Controller) -> None:
    """Raise if the controller's deformation has a form that cannot be used."""
    refuse(_of_form(problem, controller.deformation))


def _of_outputs(problem: Problem) -> Iterator[str]:
    """Reasons against outputs; those of order 0 have a response that is measured."""
    instant = [name for name, order in problem.plant.response_orders.items() if not order]
    if instant and not problem.sensing.estimator.measures_all:
        yield (
            f"{type(problem.sensing.estimator).__name__} estimates derivatives, and outputs of order 0 ({', '.join(instant)}) "
            "need none; leave the estimator out: Sensing(sensors=...)"
        )


def _of_form(problem: Problem, deformation: Deformation) -> Iterator[str]:
    """Reasons against the form, the first one first."""
    plant, form, names = problem.plant, deformation.form, problem.plant.controlled_names
    given = "dead times" if form.weights is None else "weights"
    if form.channels not in (None, len(names)):
        yield (
            f"{type(deformation).__name__}: {form.channels} {given} are given, but the plant has {len(names)} "
            f"controlled coordinates ({', '.join(names)}); give one for each, or one number for all"
        )
    yield from against_wrappers(deformation)
    for setting, values in (("cycles", every(form.cycles)), ("lag", every(form.lag))):
        if form.modelled and len(values) not in (1, len(plant.inputs)):
            own = f"{len(plant.inputs)} inputs ({', '.join(plant.inputs)})"
            yield f"ModelReferenced({setting}={values!r}): the plant has {own}; give one number for each, or one for all"
    if plant.step is not None and any(every(form.lag)):
        yield f"{type(deformation).__name__}: a map has no lag; write an actuator as a state of the map"
