"""Why twenty stages of 20 ms, planned in every cycle of 2 ms, track worse than sixty of 2 ms: optima that IPOPT finds.

The plant is the arm of `growing_stages.py`. Its discretised problem is written here once more (Runge-Kutta steps, sums of the
cost, inputs held), solved to 1e-10 in every cycle, and closed by a loop of this file: nothing of the package plans. Rows differ
in what may be the cause:

- the same problem as the package's: whether its optimiser or its warm start is the cause;
- the cost summed every 2 ms with inputs held for 20: whether the sum per stage is;
- a first stage of one cycle, or two short ones, before those of 20 ms: whether the hold of the first input is.

Printed are errors after the first second, and their ratios to sixty stages of 2 ms; the package's are in brackets.

    .venv/bin/python benchmarks/uniform_stages.py          # needs mujoco: pip install -e '.[outside]'
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from growing_stages import JOINTS, PERIOD, WAYS, problem

import fpirhc as fp

LONG = 10  # cycles of a stage of 20 ms
EQUAL = "20 of 20 ms"
LENGTHS = {
    "60 of 2 ms": (1,) * 60,
    EQUAL: (LONG,) * 20,
    "2, then 19 of 20 ms": (1, *(LONG,) * 19),
    "2, 8, then 18 of 20 ms": (1, 4, *(LONG,) * 18),
}


class Optimum:
    """The optimum of one horizon, by single shooting with IPOPT, begun at its last one.

    Args:
        task: with model, reference, weights and limits.
        lengths: of the stages, cycles.
        summed: how often the cost is summed in a stage; 1: at its start alone.
    """

    def __init__(self, task: fp.Problem, lengths: tuple[int, ...], summed: int) -> None:
        model, n = task.plant.equations, len(lengths)
        self._motion = task.reference.function(task.plant)
        inverse, p = model.inverse, ca.DM(task.plant.approximate)
        x, u, first, start = ca.SX.sym("x", 4), ca.SX.sym("u", 2, n), ca.SX.sym("x0", 4), ca.SX.sym("t")
        weights, cost, x, at = ca.DM([1e3, 1e3, 1.0, 1.0]), ca.SX(0), first, start
        assert tuple(task.plant.state.elements) == (*JOINTS, *(f"{joint}'" for joint in JOINTS))
        for k, length in enumerate(lengths):
            h = length * PERIOD / summed
            for _ in range(summed):
                wanted, response = self._motion(at)
                effort = u[:, k] - inverse(wanted, response, p)
                cost += h * (ca.dot(weights, (x - wanted) ** 2) + 1e-3 * ca.sumsqr(effort))
                x, at = _runge_kutta(lambda y, v=u[:, k]: model.rate(y, v, p), x, h), at + h
        cost += PERIOD * lengths[-1] * ca.dot(weights, (x - self._motion(at)[0]) ** 2)
        quiet = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes"}
        warm = {"ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-11, "ipopt.tol": 1e-10}
        program = {"x": ca.vec(u), "p": ca.vertcat(first, start), "f": cost}
        self._solver = ca.nlpsol("fpirhc_optimum", "ipopt", program, quiet | warm)
        low, high = task.limits.input_bounds(task.plant)
        self._bounds = {"lbx": np.tile(low, n), "ubx": np.tile(high, n)}
        self._last = np.tile(np.asarray(inverse(*self._motion(0.0), p)).ravel(), n)

    def __call__(self, time: float, state: np.ndarray) -> np.ndarray:
        """Return the first inputs of the plan of this cycle."""
        solution = self._solver(x0=self._last, p=np.r_[state, time], **self._bounds)
        assert self._solver.stats()["success"]
        self._last = np.asarray(solution["x"]).ravel()
        return self._last[:2]


def _runge_kutta(rate: ca.Function, x: ca.SX, h: float) -> ca.SX:
    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3))


def errors(task: fp.Problem, plan: Optimum) -> np.ndarray:
    """Return the rms errors, mrad, of the plant under the first inputs of the plans."""
    outside, motion = task.reality, task.reference.function(task.plant)
    assert isinstance(outside, fp.ExternalPlant)
    measured, missed = np.asarray(outside.body.reset(0)), []
    for k in range(task.cycles):
        time = k * PERIOD
        if time >= task.measure_from:
            missed.append(measured[:2] - np.asarray(motion(time)[0]).ravel()[:2])
        measured = np.asarray(outside.body.step(time, plan(time, measured[:4])))
    return 1e3 * np.sqrt(np.mean(np.square(missed), axis=0))


def of_the_package(lengths: tuple[int, ...]) -> np.ndarray:
    """Return the rms errors, mrad, of its loop on the same horizon, with a plan in every cycle."""
    relative = tuple(length / lengths[0] for length in lengths)
    horizon = fp.Horizon(len(lengths), lengths[0] * PERIOD, lengths=relative, replan="cycle")
    task = problem(horizon)
    rms = fp.measure(task, fp.simulate(task, WAYS["RHC"], seed=0)).rms_error
    return 1e3 * np.array([rms[joint] for joint in JOINTS])


def main() -> None:
    """Print the table."""
    base: dict[bool, np.ndarray] = {}
    task = problem(fp.Horizon(1, PERIOD))
    rows = [(name, lengths, 1) for name, lengths in LENGTHS.items()]
    rows.insert(2, (f"{EQUAL}, cost every 2 ms", LENGTHS[EQUAL], LONG))
    for name, lengths, summed in rows:
        texts = []
        own = errors(task, Optimum(task, lengths, summed))
        for packaged, rms in ((False, own), (True, of_the_package(lengths) if summed == 1 else None)):
            if rms is not None:
                ratio = rms / base.setdefault(packaged, rms)
                text = f"{rms[0]:.3f} {rms[1]:.3f} mrad, {ratio[0]:.2f} {ratio[1]:.2f}"
                texts.append(f"({text})" if packaged else text)
        print(f"{name:28s} {'   '.join(texts)}", flush=True)


if __name__ == "__main__":
    main()
