"""The comparison itself under test: seeded faults must all be caught, harmless changes must raise no alarm.

Faults are put into problem files, into the library behind them, into the results, and into the committed baselines. All run in
the virtual machine on a closed loop of 0.3 s.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from blessed import write_problems
from kinds import slow_but

import fpirhc as fp
from fpirhc.baselines import check, measuring
from fpirhc.baselines.baseline import fingerprint
from fpirhc.cli.main import main
from fpirhc.errors import NotSupported

CHANGED, NO_BASELINE, BAD_INPUT = 5, 6, 2
CHECK = ("check", "line.py", "--no-compile")

# Lines of the problem files
CTC = '    "CTC": fp.ComputedTorque(tracking),\n'
ADAPTIVE = '    "CTC+FPI": fp.ComputedTorque(tracking, sigmoid),\n'
SWAPPED = ADAPTIVE.replace("CTC+FPI", "CTC") + CTC.replace("CTC", "CTC+FPI")
GAIN = '        "b": fp.Parameter(approximate=1.0, exact=1.6, unit="1/kg"),\n'
SPRING = '        "k": fp.Parameter(approximate=2.0, exact=5.0, unit="1/s^2"),\n'
PUSH, SHAKE = '"u": fp.Noise(0.5)', '"y": fp.Noise(2.0)'


@pytest.fixture(scope="module")
def blessed(tmp_path_factory):
    """A folder with two problems and their baselines."""
    folder = tmp_path_factory.mktemp("blessed")
    write_problems(folder)
    return folder


@pytest.fixture(scope="module")
def right(blessed):
    """`measure_all` of the files as they were blessed; each run is made once."""
    tasks = {name: fp.load_problem(str(blessed / f"{name}.py")) for name in ("line", "noisy")}
    measured = cache(lambda name, job: measuring.measure_job(tasks[name], job))
    return lambda task, jobs, **more: [measured(task.name, job) for job in jobs]


@pytest.fixture
def folder(blessed, tmp_path, monkeypatch):
    """A copy that a test may spoil."""
    copy = tmp_path / "project"
    shutil.copytree(blessed, copy)
    monkeypatch.chdir(copy)
    return copy


def edited(old, new, name="line"):
    """A fault in a problem file."""

    def fault(folder, patch):
        path = folder / f"{name}.py"
        text = path.read_text()
        assert text.count(old) == 1, f"the file says '{old}' {text.count(old)} times"
        path.write_text(text.replace(old, new))

    return fault


def baseline(change, *, signed=True, name="line"):
    """A fault in a committed baseline, with a checksum that fits it or with the old one."""

    def fault(folder, patch):
        path = folder / "baselines" / f"{name}.json"
        facts = json.loads(path.read_text())
        facts = change(facts) or facts
        if signed:
            facts.pop("checksum", None)
            facts["checksum"] = fingerprint(facts)
        path.write_text(json.dumps(facts))

    return fault


def wrong_way(folder, patch):
    """The deformation moves against its own sign."""
    ordinary = fp.Sigmoid.step

    def step(self, before, response, desired, memory):
        deformed, next_memory = ordinary(self, before, response, desired, memory)
        return 2 * before - deformed, next_memory

    patch.setattr(fp.Sigmoid, "step", step)


def dropped_term(folder, patch):
    """The library forgets a term of the cost."""
    ordinary = fp.Quadratic.stage
    patch.setattr(fp.Quadratic, "stage", lambda self, view: {"states": ordinary(self, view)["states"]})


def shorter_horizon(module):
    """A horizon with one stage too few."""

    def fault(folder, patch):
        import importlib

        owner = importlib.import_module(module)
        for name in ("transcribe", "stage_data"):
            ordinary = getattr(owner, name)
            patch.setattr(
                owner,
                name,
                lambda plant, reference, horizon, cost, *more, _do=ordinary, **named: _do(
                    plant, reference, replace(horizon, stages=horizon.stages - 1), cost, *more, **named
                ),
            )

    return fault


def wrong_integrator(folder, patch):
    """The simulated plant moves by Euler steps."""
    patch.setattr(fp.RungeKutta4, "step", lambda self, plant, period: fp.Euler().step(plant, period))


def one_cycle_less(folder, patch):
    """A run that ends one cycle early."""
    ordinary = vars(fp.Problem)["cycles"].fget
    patch.setattr(fp.Problem, "cycles", property(lambda self: ordinary(self) - 1))


def result(change):
    """A fault in what is measured of every run."""

    def fault(folder, patch):
        ordinary = measuring._numbers

        def spoilt(measured):
            numbers = ordinary(measured)
            change(numbers)
            return numbers

        patch.setattr(measuring, "_numbers", spoilt)

    return fault


def becomes(name, change):
    """One metric changes wherever it is."""
    return lambda numbers: numbers.update({k: change(v) for k, v in numbers.items() if k == name})


def plan(change):
    """A fault in what is measured of open-loop plans."""

    def fault(folder, patch):
        ordinary = measuring.first_plan
        patch.setattr(
            measuring,
            "first_plan",
            lambda *arguments: {k: change.get(k, lambda v: v)(v) for k, v in ordinary(*arguments).items()},
        )

    return fault


def ends_early(folder, patch):
    """A run that diverges."""
    ordinary = vars(measuring)["simulate"]
    patch.setattr(
        measuring, "simulate", lambda *arguments, **more: replace(ordinary(*arguments, **more), stop="it diverged")
    )


def refused(folder, patch):
    """A controller that does not serve the problem any more."""

    def simulate(problem, controller, **more):
        raise NotSupported("not any more")

    patch.setattr(measuring, "simulate", simulate)


def swapped_results(folder, patch):
    """Results that belong to other controllers."""
    ordinary = vars(check)["measure_all"]
    patch.setattr(check, "measure_all", lambda *arguments, **more: ordinary(*arguments, **more)[::-1])


def louder_noise(folder, patch):
    """Noise of another size."""
    ordinary = fp.Noise.values
    patch.setattr(fp.Noise, "values", lambda self, times, random: 10 * ordinary(self, times, random))


def without(name):
    """A file that is not there any more."""
    return lambda folder, patch: (folder / name).unlink()


def emptied(name):
    """A file with nothing in it."""
    return lambda folder, patch: (folder / name).write_text("")


def exchanged_baselines(folder, patch):
    """Each problem has the other's baseline."""
    first, second = folder / "baselines" / "line.json", folder / "baselines" / "noisy.json"
    first.rename(folder / "kept")
    second.rename(first)
    (folder / "kept").rename(second)


def hidden(folder, patch):
    """A problem with a baseline that is listed as unchecked."""
    (folder / "baselines" / "unchecked.toml").write_text('line = "no time"')


def rms(key, value):
    """Another entry of one metric."""
    return lambda facts: facts["controllers"]["CTC"]["metrics"]["rms_error.y"].update({key: value})


def emptied_metrics(facts):
    facts["controllers"] = {name: {**one, "metrics": {}} for name, one in facts["controllers"].items()}


# What settings and files say of themselves, whatever the runs give.
WRITTEN_FAULTS = {
    # in the problem file: the settings say so
    "sign of a gain": (NO_BASELINE, CHECK, edited("gain=-0.5", "gain=0.5")),
    "size of a gain": (NO_BASELINE, CHECK, edited("gain=-0.5", "gain=-0.4999")),
    "dropped weight": (NO_BASELINE, CHECK, edited(', "y\'": 1.0}', "}")),
    "changed weight": (NO_BASELINE, CHECK, edited('"u": 1e-2', '"u": 2e-2')),
    "one stage less": (NO_BASELINE, CHECK, edited("stages=8", "stages=7")),
    "changed tolerance": (NO_BASELINE, CHECK, edited("tolerance=1e-3", "tolerance=1e-2")),
    "more iterations": (NO_BASELINE, CHECK, edited("iterations=1", "iterations=2")),
    "exact parameter": (NO_BASELINE, CHECK, edited("exact=1.6", "exact=1.6001")),
    "approximate parameter": (NO_BASELINE, CHECK, edited("approximate=2.0", "approximate=2.0001")),
    "limit": (NO_BASELINE, CHECK, edited("(-25.0, 25.0)", "(-25.0, 26.0)")),
    "measured from another time": (NO_BASELINE, CHECK, edited("measure_from=0.1", "measure_from=0.101")),
    "swapped controllers": (NO_BASELINE, CHECK, edited(CTC + ADAPTIVE, SWAPPED)),
    "controller taken out": (CHANGED, CHECK, edited(CTC, "")),
    # in the files
    "problem taken out": (BAD_INPUT, ("check", "--no-compile"), without("noisy.py")),
    "baseline taken out": (NO_BASELINE, ("check", "--no-compile"), without("baselines/noisy.json")),
    "problem listed as unchecked": (BAD_INPUT, ("check", "--no-compile"), hidden),
    "empty baseline file": (NO_BASELINE, CHECK, emptied("baselines/line.json")),
    "baseline of nothing": (NO_BASELINE, CHECK, baseline(lambda f: f.update(controllers={}))),
    "baseline without metrics": (NO_BASELINE, CHECK, baseline(emptied_metrics)),
    "band widened by hand": (NO_BASELINE, CHECK, baseline(rms("band", 1e3), signed=False)),
    "value edited by hand": (NO_BASELINE, CHECK, baseline(rms("value", 0.1), signed=False)),
    "band taken out": (NO_BASELINE, CHECK, baseline(rms("band", None))),
    "NaN for a value": (NO_BASELINE, CHECK, baseline(rms("value", float("nan")))),
    "exchanged baselines": (NO_BASELINE, CHECK, exchanged_baselines),
}  # fmt: skip
FAULTS = WRITTEN_FAULTS | {
    "controller added": (CHANGED, CHECK, edited("controllers = {", 'controllers = {"X": fp.ComputedTorque(tracking),')),
    # in the problem file: formulas, which settings do not show
    "reference": (CHANGED, CHECK, edited("ca.sin(2 * t)", "1.0001 * ca.sin(2 * t)")),
    "sign in the response": (CHANGED, CHECK, edited("p.b * u.u - p.k", "p.b * u.u + p.k")),
    # in the library
    "deformation the wrong way": (CHANGED, CHECK, wrong_way),
    "dropped cost term": (CHANGED, CHECK, dropped_term),
    "off by one in open-loop plans": (CHANGED, CHECK, shorter_horizon("fpirhc.studies.open_loop")),
    "off by one in the loop": (CHANGED, CHECK, shorter_horizon("fpirhc.controllers.receding_horizon")),
    "wrong integrator": (CHANGED, CHECK, wrong_integrator),
    "one cycle less": (CHANGED, CHECK, one_cycle_less),
    "louder noise": (CHANGED, ("check", "noisy.py", "--no-compile"), louder_noise),
    "diverged run": (CHANGED, CHECK, ends_early),
    "refused controller": (CHANGED, CHECK, refused),
    # in the results
    "metric becomes NaN": (CHANGED, CHECK, result(becomes("rms_error.y", lambda v: float("nan")))),
    "factor becomes NaN": (CHANGED, CHECK, result(becomes("contraction.measured", lambda v: float("nan")))),
    "metric becomes infinite": (CHANGED, CHECK, result(becomes("contraction.predicted", lambda v: float("inf")))),
    "metric vanishes": (CHANGED, CHECK, result(lambda n: n.pop("iae.y"))),
    "metric out of its band": (CHANGED, CHECK, result(becomes("max_error.y", lambda v: 1.0001 * v))),
    "metric much better": (CHANGED, CHECK, result(becomes("rms_error.y", lambda v: 0.5 * v))),
    "one cycle of another status": (CHANGED, CHECK, result(becomes("status.OK", lambda v: v - 1))),
    "optimal cost": (CHANGED, CHECK, plan({"plan.cost": lambda v: v * (1 + 1e-5)})),
    "plan not converged": (CHANGED, CHECK, plan({"plan.status": lambda v: "NOT_CONVERGED"})),
    "swapped results": (CHANGED, CHECK, swapped_results),
}  # fmt: skip


def test_there_are_thirty_faults():
    """As many as promised, so that none is taken out unnoticed."""
    assert len(FAULTS) >= 30


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_caught(name, folder, right, monkeypatch, capsys):
    """Each has the exit code of its kind, and no baseline is written."""
    code, command, fault = FAULTS[name]
    if name in WRITTEN_FAULTS:
        monkeypatch.setattr(check, "measure_all", right)
    fault(folder, monkeypatch)
    before = {path.name: path.read_bytes() for path in folder.rglob("*.json")}
    assert main(command) == code, capsys.readouterr().out
    assert {path.name: path.read_bytes() for path in folder.rglob("*.json")} == before


def rewritten(**options):
    """The same baseline, written in another manner."""

    def change(folder, patch):
        path = folder / "baselines" / "line.json"
        path.write_text(json.dumps(json.loads(path.read_text()), **options))

    return change


def reversed_keys(folder, patch):
    """The same baseline with all keys in reverse order."""

    def turned(value):
        return {k: turned(v) for k, v in reversed(value.items())} if isinstance(value, dict) else value

    path = folder / "baselines" / "line.json"
    path.write_text(json.dumps(turned(json.loads(path.read_text()))))


def line_endings(folder, patch):
    """What a checkout on another system does."""
    for path in (folder / "baselines" / "line.json", folder / "line.py"):
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))


def several(*changes):
    def change(folder, patch):
        for one in changes:
            one(folder, patch)

    return change


def compiler_flags(folder, patch):
    """Another level of optimisation, and fused multiply-add where the machine has it."""
    from fpirhc.symbolic import native

    flags = tuple({"-O3": "-O0", "-ffp-contract=off": "-ffp-contract=fast"}.get(f, f) for f in native._FLAGS)
    patch.setattr(native, "_FLAGS", flags)


def chunk(folder, patch):
    """Another number of cycles per call."""
    from fpirhc.simulation.path import Mover

    patch.setattr(Mover, "cycles_of_call", 77)


def other_seed(seed):
    """Another draw of the noise."""

    def change(folder, patch):
        ordinary = vars(check)["nominal"]
        patch.setattr(check, "nominal", lambda _, compiled: ordinary(seed, compiled))

    return change


def finer(folder, patch):
    """More steps of the simulated plant."""
    ordinary = fp.RungeKutta4.step
    patch.setattr(
        fp.RungeKutta4, "step", lambda self, plant, period: ordinary(replace(self, substeps=3), plant, period)
    )


def spoilt_globals(folder, patch):
    """A run does not depend on NumPy's global generator, on the log level or on the width of the terminal."""
    np.random.seed(12345)  # noqa: NPY002 -- the global generator is what is spoilt
    logging.getLogger().setLevel(logging.DEBUG)
    patch.setenv("COLUMNS", "30")
    patch.setenv("LC_ALL", "C")


def debug_log(folder, patch):
    """Everything is logged."""
    patch.setattr(logging.getLogger(), "level", logging.DEBUG)


def new_unchecked(folder, patch):
    """A new problem without a baseline, with a reason."""
    (folder / "later.py").write_text("problem = None\ncontrollers = {}\n")
    (folder / "baselines" / "unchecked.toml").write_text('later = "not finished"\n')


NOISY = ("check", "noisy.py", "--no-compile")
WRITTEN_OTHERWISE = {
    "white space in JSON": (CHECK, rewritten(indent=None, separators=(",", ":"))),
    "indented JSON": (CHECK, rewritten(indent=7)),
    "sorted JSON": (CHECK, rewritten(sort_keys=True)),
    "reversed JSON": (CHECK, reversed_keys),
    "line endings": (CHECK, line_endings),
    "time of the file": (CHECK, lambda folder, patch: os.utime(folder / "baselines" / "line.json", (0, 0))),
    "versions": (CHECK, baseline(lambda f: f["versions"].update(casadi="3.7.2", machine="arm64"))),
    "new problem with a reason": (("check", "--no-compile"), new_unchecked),
    "helper beside the problems": (("check", "--no-compile"), lambda folder, patch: (folder / "helper.py").write_text("1 / 0")),
    "reports": ((*CHECK, "--markdown", "a.md", "--all"), several()),
}  # fmt: skip
HARMLESS = WRITTEN_OTHERWISE | {
    "nothing": (CHECK, several()),
    "order of controllers": (CHECK, edited(CTC + ADAPTIVE, ADAPTIVE + CTC)),
    "order of parameters": (CHECK, edited(GAIN + SPRING, SPRING + GAIN)),
    "order of weights": (CHECK, edited('{"y": 100.0, "y\'": 1.0}', '{"y\'": 1.0, "y": 100.0}')),
    "title and comments": (CHECK, edited('with a wrong gain."""', 'otherwise."""\n# with a comment')),
    "formula written otherwise": (CHECK, edited("p.b * u.u - p.k * q.y", "-(q.y * p.k) + u.u * p.b")),
    "a headline": (CHECK, edited("controllers = {", 'headline = ("CTC", "CTC+FPI")\ncontrollers = {')),
    "two processes": ((*CHECK, "--processes", "2"), several()),
    "compiled C": (("check", "line.py"), several()),
    "compiler flags": (("check", "line.py"), compiler_flags),
    "length of a chunk": (CHECK, chunk),
    "log level": (CHECK, debug_log),
    "global generator, locale, terminal": (CHECK, spoilt_globals),
    "finer integrator": (CHECK, finer),
    "order of the noises": (NOISY, edited(f"{PUSH}, {SHAKE}", f"{SHAKE}, {PUSH}", "noisy")),
    "seed 17": (NOISY, other_seed(17)),
    "seed 4711": (NOISY, other_seed(4711)),
}  # fmt: skip


def test_there_are_twenty_harmless_changes():
    """As many as promised."""
    assert len(HARMLESS) >= 20


@pytest.mark.parametrize("name", slow_but(HARMLESS, *list(HARMLESS)[::2]))
def test_harmless_changes_raise_no_alarm(name, folder, right, monkeypatch, capsys):
    """Exit code 0."""
    command, change = HARMLESS[name]
    if name in WRITTEN_OTHERWISE:
        monkeypatch.setattr(check, "measure_all", right)
    change(folder, monkeypatch)
    assert main(command) == 0, capsys.readouterr().out
