"""Generic code asks objects for facts: what a user adds is treated as what ships, a wrapper of a wrapper as what it is made of."""

from __future__ import annotations

import ast
import importlib
import inspect
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from helpers.reviewed import answers, mass, torque

import fpirhc
import fpirhc as fp
from fpirhc.contracts import Controller, Deformation, closing_blocks, reference_block
from fpirhc.controllers.base import rename
from fpirhc.controllers.contract import resolved, with_optimiser, without_deformation
from fpirhc.errors import InvalidProblem, NotSupported
from fpirhc.studies.open_loop import with_optimisers

TRACK = fp.Exponential(rate=6.0)
PLAN = fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3))
LIMITS = fp.Limits(inputs={"u": (-20.0, 20.0)})
LOOKING_AHEAD = {
    "horizon": fp.Horizon(stages=10, step=1e-2),
    "cost": fp.Quadratic(states={"q": 1e3, "q'": 1.0}, deviation={"u": 1e-3}),
    "limits": LIMITS,
    "duration": 0.2,
    "start": {"q": 0.05},
}
FILTER = fp.DisturbanceKalman(drift={"q": 1e-3}, measured={"q": 1e-4, "q'": 1e-4}, noise={"q": 1e-3})


# What a user writes


@dataclass(frozen=True)
class Gentle(Deformation):
    """r+ = r + (gain / 2) (f - d), as Affine, but a user's own."""

    gain: float

    def step(self, request, response, desired, memory):
        """Return r + (gain / 2) (f - d)."""
        del memory
        return request + 0.5 * self.gain * (response - desired), {}

    def effective_gain(self):
        return -0.5 * self.gain

    def secant_gain(self):
        return -0.5 * self.gain

    def largest_step(self):
        return float("inf")

    def with_effective_gain(self, gain):
        return replace(self, gain=-2 * gain)


@dataclass(frozen=True)
class Named(Controller):
    """A user's own wrapper, which adds nothing."""

    wrapped: Controller
    label: str = "mine"

    @property
    def inner(self):
        return self.wrapped

    @property
    def deformation(self):
        return self.wrapped.deformation

    def blocks(self, problem):
        return self.wrapped.blocks(problem)


@dataclass(frozen=True)
class Follower(Controller):
    """A user's own controller: the reference's response is the desired one."""

    deformation: Deformation = field(default_factory=fp.Identity)

    def blocks(self, problem):
        response = problem.plant.response_signal
        closing, delays = closing_blocks(problem, self.deformation)
        copies = [rename(n, response("_reference_response"), response(n)) for n in ("nominal", "desired")]
        return [reference_block(problem), *copies, *closing], delays


def twice(controller: Controller) -> Named:
    """A user's wrapper of a user's wrapper."""
    return Named(Named(controller), label="outer")


# Deformations


def test_a_users_map_is_reviewed_as_the_shipped_one_that_it_equals():
    """R - 0.25 h, once as Affine and once as a user's own map: the same answers to every question, by its own name."""
    own, shipped = (answers(mass(limits=LIMITS), fp.ComputedTorque(TRACK, d)) for d in (Gentle(-0.5), fp.Affine(-0.5)))
    assert own
    assert own == shipped


# Automatic settings


@pytest.mark.parametrize("wrap", [lambda c: c, twice], ids=["alone", "wrapped twice"])
def test_a_users_controller_takes_the_recommended_map(wrap):
    """The scale of Sigmoid(gain=-0.5) is chosen for it as for a shipped controller on the same reference."""
    problem = mass(reference=fp.Trajectory(lambda t: {"q": 40.0 * t**3}), start={"q": 0.0}, period=2e-2)
    resolved_controller: Any = resolved(problem, wrap(Follower(fp.Sigmoid(gain=-0.5)))).deformation
    assert resolved_controller.scale == pytest.approx(
        2 * 2e-2 * 240.0, rel=1e-2
    )  # twice what q'' = 240 t changes in one cycle
    run = fp.simulate(mass(duration=0.1), wrap(Follower(fp.Sigmoid(gain=-0.5))), seed=0, compiled=False)
    assert run.stop is None
    limit: Any = run.settings["step_limit"]
    assert limit > 0


# Controllers


@pytest.mark.parametrize(
    ("controller", "settings"),
    [
        (torque(), {}),
        (fp.Predicted(torque(), inputs=2e-3), {"dead_time": fp.DeadTime(inputs={"u": 2e-3})}),
        (fp.Estimating(PLAN, FILTER), LOOKING_AHEAD),
    ],
    ids=["torque", "predicted", "estimating"],
)
def test_a_wrapper_of_a_wrapper_is_reviewed_as_what_it_is_made_of(controller, settings):
    problem = mass(**settings)
    plain, wrapped = answers(problem, controller), answers(problem, twice(controller))
    assert plain
    assert wrapped == plain


def test_optimisers_vary_inside_wrappers():
    """Compare delayed_mass --optimisers reduced-gradient: both plans are inside Predicted."""
    varied = with_optimisers(fp.load_problem("delayed_mass"), ["reduced-gradient"], None)
    assert list(varied.controllers) == ["RHC (reduced gradient)", "RHC+FPI (reduced gradient)"]
    for controller in varied.controllers.values():
        assert isinstance(controller, fp.Predicted)
        assert controller.planner is not None
        assert isinstance(controller.planner.optimiser, fp.ReducedGradient)
    run = fp.simulate(
        replace(varied.problem, duration=20 * varied.problem.period, measure_from=0.0),
        twice(controller),
        seed=0,
        compiled=False,
    )
    assert run.stop is None


def test_no_named_controller_is_dropped():
    """leaking_tanks by name: each of them is varied; one that does not plan stays, and alone it is refused."""
    task = fp.load_problem("leaking_tanks")
    task = replace(task, controllers={**task.controllers, "CTC": fp.ComputedTorque(TRACK)})
    names = list(task.controllers)
    varied = with_optimisers(task, ["ipopt"], names)
    assert list(varied.controllers) == [*(f"{n} (IPOPT)" for n in names if n != "CTC"), "CTC"]
    planner = varied.controllers["RHC offset-free (IPOPT)"].planner
    assert planner is not None
    assert isinstance(planner.optimiser, fp.Ipopt)
    with pytest.raises(InvalidProblem, match="none of CTC plans"):
        with_optimisers(task, ["ipopt"], ["CTC"])


def test_a_pair_is_found_through_wrappers():
    """Without its deformation a wrapped controller is described as the wrapped plain one."""
    plain, adaptive = (twice(fp.ComputedTorque(TRACK, d)) for d in (fp.Identity(), fp.Affine(-0.5)))
    assert without_deformation(adaptive) == plain
    assert without_deformation(plain) is plain
    with pytest.raises(NotSupported, match="no deformation that can be replaced"):
        Named(fp.rivals.AccelerationFeedback(TRACK, gain=1.0)).with_deformation(fp.Affine(-0.5))


def test_a_wrapper_that_hides_its_inner_controller_says_what_to_do():
    """A wrapper whose inner controller is in no field cannot be rebuilt."""

    @dataclass(frozen=True)
    class Listed(Named):
        wrapped: tuple[Controller, ...]  # type: ignore[assignment]  # where nobody finds it

        @property
        def inner(self):
            return self.wrapped[0]

        @property
        def deformation(self):
            return self.inner.deformation

    with pytest.raises(NotSupported, match=r"hold it in a field"):
        with_optimiser(Listed((PLAN,)), fp.ReducedGradient(iterations=5, tolerance=1e-3))


# What generic code names

PACKAGE = Path(fpirhc.__file__).parent
CONTRACTS = (
    "controllers.contract.Controller",
    "controllers.replanning.Replanning",
    "controllers.slots.schedules.Schedule",
    "controllers.wrappers.predicted.Predictor",
    "deformation.base.Deformation",
    "horizon.cost.Cost",
    "learning.estimators.base.ParameterEstimator",
    "learning.rules.base.Rule",
    "optimisers.base.Optimiser",
    "plant.integrators.Integrator",
    "sensing.base.DerivativeEstimator",
    "task.disturbance.Disturbance",
    "tracking.base.Tracking",
)
GENERIC: tuple[str, ...] = ("baselines", "contraction", "problem_files", "report", "review", "scaffold")
GENERIC += ("simulation", "studies", "task")
GENERIC_FILES = [f"controllers/{name}.py" for name in ("base", "contract", "demands", "check", "tracked")]
GENERIC_FILES += ["deformation/base.py", "tracking/base.py"]
# Values that generic code builds for itself; it asks nobody whether he is one.
BUILDS = {
    "controllers/contract.py": {"Identity"},  # no adaptation: the neutral map
    "studies/comparison/verdict.py": {"HeldInput"},  # the plant with nobody at it
    "studies/limits.py": {"Noise"},  # the noise of the sensors at which a controller fails is sought
    "task/checks.py": {"MapSteps", "StepDifference"},  # what a map has in place of an integrator and of its response
}
# A theorem about two maps, in a room that nothing else imports.
THEOREM = {"certificate/limits.py": {"Affine", "ModelReferenced"}}


@cache
def parsed(path: Path) -> ast.Module:
    """The tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def contracts() -> tuple[type, ...]:
    """The families' contracts."""
    collected = []
    for path in CONTRACTS:
        module, _, name = path.rpartition(".")
        collected.append(getattr(importlib.import_module(f"fpirhc.{module}"), name))
    return tuple(collected)


@cache
def names_in(path: Path) -> dict[str, Any]:
    """What a file imports or defines by name, imports inside of functions included."""
    module = importlib.import_module(".".join(["fpirhc", *path.relative_to(PACKAGE).with_suffix("").parts]))
    nodes = [n for n in ast.walk(parsed(path)) if isinstance(n, ast.ImportFrom)]
    inside = [(n.module, a) for n in nodes if n.col_offset and str(n.module).startswith("fpirhc.") for a in n.names]
    late = {a.asname or a.name: getattr(importlib.import_module(str(source)), a.name) for source, a in inside}
    return late | vars(module)


def named_members(path: Path, used: set[str]) -> set[str]:
    """Names in `used` that a file imports or defines and that are members of a family."""
    if not used:
        return set()
    families, known = contracts(), names_in(path)
    values = {name: known.get(name) for name in used}
    return {n for n, v in values.items() if inspect.isclass(v) and issubclass(v, families) and v not in families}


def asked_classes(tree: ast.AST) -> set[str]:
    """Names of classes in isinstance, issubclass, `type(x) is` and class patterns."""
    collected: list[ast.AST] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("isinstance", "issubclass"):
            collected.append(node.args[1])
        elif isinstance(node, ast.MatchClass):
            collected.append(node.cls)
        elif (
            isinstance(node, ast.Compare)
            and isinstance(node.left, ast.Call)
            and getattr(node.left.func, "id", "") == "type"
        ):
            collected += node.comparators
    return {n.id for one in collected for n in ast.walk(one) if isinstance(n, ast.Name)}


def files() -> list[Path]:
    """All modules of the package that can be imported without starting something."""
    return [p for p in sorted(PACKAGE.rglob("*.py")) if p.name not in ("__main__.py", "__init__.py", "worker.py")]


def test_nobody_is_asked_for_his_class():
    """No isinstance, issubclass, type comparison or pattern on a member of a family, in any file."""
    ladders = {}
    for path in files():
        members = named_members(path, asked_classes(parsed(path)))
        if members:
            ladders[str(path.relative_to(PACKAGE))] = members
    assert ladders == THEOREM


def test_generic_code_names_no_members():
    """It imports contracts; the few values that it builds for itself are listed above."""
    collected = {}
    for path in files():
        name = path.relative_to(PACKAGE).as_posix()
        if name.split("/")[0] not in GENERIC and name not in GENERIC_FILES:
            continue
        imported = {
            a.asname or a.name for n in ast.walk(parsed(path)) if isinstance(n, ast.ImportFrom) for a in n.names
        }
        members = {m for m in named_members(path, imported) if _is_foreign(path, m)}
        if members:
            collected[name] = members
    assert collected == BUILDS


def _is_foreign(path: Path, name: str) -> bool:
    """Whether a class is a concrete one of another part of the package than the file's."""
    one: type = names_in(path)[name]
    return not inspect.isabstract(one) and one.__module__.split(".")[1] != path.relative_to(PACKAGE).parts[0]


def test_the_search_finds_a_ladder():
    """The scan itself: a ladder over concrete maps is seen."""
    text = "def f(m):\n    return isinstance(m, RFPT | Rotation) or type(m) is Affine\n"
    assert asked_classes(ast.parse(text)) == {"RFPT", "Rotation", "Affine"}
