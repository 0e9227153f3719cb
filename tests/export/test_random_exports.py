"""Random settings, samples, faults and instances: what leaves Python answers as the stepper, bit by bit; and what may not leave."""

import ctypes
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.exports import COMPILERS, Exported, exported
from helpers.first_files import messages_of
from helpers.kinds import slow_but
from helpers.replay import samples as samples_of

import fpirhc as fp
from fpirhc import Status
from fpirhc.__main__ import main

# Controllers of states, of outputs, of a map and of sensors, a plan, and what of each may be live.
CASES = {
    "torque": ("two_mass", "CTC+FPI (eq 6)", ("deformation.gain", "tracking.rate", "limits.inputs.Q1.1")),
    "vector": ("two_mass", "CTC+FPI (eq 3)", ("deformation.gain", "limits.inputs.Q2.0", "limits.inputs.Q2.1")),
    "outputs": ("anaesthesia", "CTC+FPI", ("deformation.gain", "limits.inputs.infusion.0", "limits.inputs.infusion.1")),
    "map": ("fishery", "CTC+FPI", ("deformation.map.gain", "limits.inputs.effort.0", "limits.inputs.effort.1")),
    "plan": ("leaking_tanks", "RHC+FPI", ("deformation.gain", "limits.inputs.u.0", "limits.inputs.u.1")),
}
INSTANCES, CYCLES, CHANGES = 2, 80, 5
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]


@cache
def samples(of: str, title: str) -> np.ndarray:
    """Samples of a run of a controller, its time first, without the time."""
    task = fp.load_problem(of)
    short = replace(task.problem, duration=CYCLES * task.problem.period, measure_from=0.0)
    return samples_of(fp.simulate(short, task.controllers[title], seed=0, compiled=False))


def random_rows(name: str, device: Exported, random: np.random.Generator, bad: Sequence[float]) -> np.ndarray:
    """Samples of a run with noise; one in eight has a number of `bad`, one in twenty comes after missed cycles, or once more."""
    of, title, _ = CASES[name]
    rows = samples(of, title) * (1 + 1e-3 * random.standard_normal((CYCLES, 1)))
    time = np.cumsum(np.where(random.random(CYCLES) < 0.05 * bool(bad), random.integers(0, 70, CYCLES), 1))
    rows = np.hstack([device.problem.period * time[:, None], rows])
    for k in range(CYCLES):
        if bad and random.random() < 0.125:
            rows[k, random.integers(rows.shape[1])] = random.choice(bad)
    return rows


class Library:
    """A controller as a shared library, called with arrays."""

    def __init__(self, device: Exported) -> None:
        [path] = [one for one in device.folder.glob("arm_*") if one.suffix in (".so", ".dylib", ".dll")]
        self.called = ctypes.CDLL(str(path))
        self.paths, self.commands = list(device.layout["bounds"]), device.problem.plant.input.size

    def begun(self) -> ctypes.Array[ctypes.c_char]:
        """One more instance."""
        made = ctypes.create_string_buffer(self.called.arm_size())
        self.called.arm_begin(made)
        return made

    def cycle(self, instance: ctypes.Array[ctypes.c_char], row: np.ndarray) -> list[float]:
        """Status and command of one cycle."""
        command = (ctypes.c_double * self.commands)()
        return [self.called.arm_cycle(instance, (ctypes.c_double * len(row))(*row), command), *command]

    def change(self, instance: ctypes.Array[ctypes.c_char], path: str, value: float) -> bool:
        """Whether a number is put in force."""
        return bool(self.called.arm_change(instance, self.paths.index(path), ctypes.c_double(value)))


Change = tuple[str, float]


def random_changes(device: Exported, random: np.random.Generator) -> dict[int, list[Change]]:
    """Numbers inside the bounds of a setting and, one in three, not: no numbers, and those far outside."""
    changes: dict[int, list[Change]] = {}
    start = settings_of(device)
    for k in sorted(random.choice(CYCLES, CHANGES, replace=False).tolist()):
        path = list(device.bounds)[random.integers(len(device.bounds))]
        low, high = device.bounds[path]
        near = start[path] * random.uniform(0.7, 1.1)
        span = abs(start[path]) + 1.0
        outside = [np.nan, np.inf, -np.inf, *(end for end in (low - span, high + span) if np.isfinite(end))]
        changes.setdefault(k, []).append((path, float(random.choice(outside)) if random.random() < 1 / 3 else near))
    return changes


def is_allowed(device: Exported, now: dict[str, float], path: str, value: float) -> bool:
    """Whether a device is to take a number: finite, inside its bounds, and an interval stays one."""
    low, high = device.bounds[path]
    owner, _, end = path.rpartition(".")
    other = now.get(f"{owner}.{ {'0': '1', '1': '0'}.get(end, '') }")
    ordered = other is None or (value < other if end == "0" else value > other)
    return bool(np.isfinite(value) and low <= value <= high and ordered)


def stepped(
    device: Exported, rows: np.ndarray, changes: dict[int, list[Change]]
) -> Iterator[tuple[list[bool], list[float]]]:
    """What is to come in every cycle: whether changes are taken, and the status and command of Python with those that are."""
    stepper, now = device.stepper, settings_of(device)
    memory = stepper.start()
    for k, row in enumerate(rows):
        taken = []
        for path, value in changes.get(k, []):
            taken.append(is_allowed(device, now, path, value))
            if taken[-1]:
                assert stepper.change({path: value})
                now[path] = value
            elif np.isnan(value):  # Python takes limits wider than those of the build, and infinite ones
                assert not stepper.change({path: value})
        command, memory = stepper.step_measured(row[0], row[1:], memory)
        yield taken, [float(stepper.trace()["status"].ravel()[0]), *command]


def settings_of(device: Exported) -> dict[str, float]:
    """The settings of the build, by path."""
    start = zip(device.stepper.reads.columns, device.stepper.reads.start().tolist(), strict=True)
    return {column.removeprefix("settings."): value for column, value in start if column.startswith("settings.")}


def back(device: Exported) -> None:
    """The settings of the build."""
    if device.bounds:
        start = settings_of(device)
        assert device.stepper.change({path: start[path] for path in device.bounds})


@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", slow_but(CASES, "outputs", "plan"))
def test_instances_with_settings_of_their_own_answer_as_the_stepper(name, seed, tmp_path):
    """Cycles of two controllers in any order, settings that change in between, samples with faults: bits, statuses, refusals."""
    random = np.random.default_rng(seed)
    of, title, live = CASES[name]
    one = exported(tmp_path / "library", of, title, "library", live=live)
    library = Library(one)
    bad = (np.nan, np.inf, -np.inf, 1e9, -1e200, 0.0)
    rows = [random_rows(name, one, random, bad) for _ in range(INSTANCES)]
    changes = [random_changes(one, random) for _ in range(INSTANCES)]
    wanted = []
    for own, changed in zip(rows, changes, strict=True):
        back(one)
        wanted.append(list(stepped(one, own, changed)))
    assert library.called.arm_change(library.begun(), 99, ctypes.c_double(1.0)) == 0
    instances, at = [library.begun() for _ in range(INSTANCES)], [0] * INSTANCES
    for j in random.permutation(np.repeat(np.arange(INSTANCES), CYCLES)):
        k = at[j]
        taken = [library.change(instances[j], *change) for change in changes[j].get(k, [])]
        assert (taken, library.cycle(instances[j], rows[j][k])) == wanted[j][k], f"instance {j}, cycle {k}"
        at[j] += 1
    refused = [not yes for answers in wanted for taken, _ in answers for yes in taken]
    assert any(refused)
    assert not all(refused)
    statuses = {answer[0] for answers in wanted for _, answer in answers}
    assert {int(Status.BAD_SAMPLE), int(Status.BRIDGED)} <= statuses


# Refusals: the whole message of each, with what to do instead
WITH_IPOPT = """import fpirhc as fp

problem = fp.load_problem("two_mass").problem
controllers = {"ipopt": fp.RecedingHorizon(fp.Ipopt(1e-6), fp.Sigmoid(gain=-0.5, scale=50.0))}
"""
ROWS = messages_of("""
two_mass RHC+FPI --to cc =>
    the target 'cc' is unknown; one of arduino, c, fmu2, library, wasm, lab
two_mas RHC+FPI =>
    problem 'two_mas' is unknown. Did you mean 'two_mass'? Give the path of a problem file, or a name from 'fpirhc list'
own.py ipopt =>
    'ipopt' cannot be exported: it calls a solver that is not written as C, but linked as a library (coin-or/IpStdCInterface.h
    is its header). In place of Ipopt use FixedPointSolver(iterations=1, tolerance=...), which is C of its own
two_mass RHC+FPI --to wasm =>
    the target wasm needs ziglang, not installed here: pip install 'fpirhc[compiler]'
two_mass RHC+FPI --to fmu2 =>
    the target fmu2 needs fmpy, not installed here: pip install 'fpirhc[fmu]'
two_mass RHC+FPI --to library =>
    a shared library needs a C compiler: compilation is turned off (FPIRHC_CC=none); install gcc or clang, or pip install
    'fpirhc[compiler]'
two_mass RHC+FPI --out full =>
    'full' is not an empty folder; nothing in it is replaced; choose another with --out
two_mass RHC+FPI --name 2nd =>
    '2nd' cannot be the name of a controller in C: expected at most 40 letters, digits and underscores, a letter first, and no
    word of C or of the files beside it. Did you mean 'c_2nd'?
""")


@pytest.mark.parametrize("row", ROWS)
def test_what_is_refused_says_why_and_what_to_do(row, tmp_path, monkeypatch, capsys):
    """Exit code 2, or 3 for a folder; one line, and nothing is written."""
    words = re.findall(r"RHC\+FPI|\S+", row)
    (tmp_path / "own.py").write_text(WITH_IPOPT)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    for module in ("ziglang", "fmpy"):
        monkeypatch.setitem(__import__("sys").modules, module, None)
    if "library" in words:
        monkeypatch.setenv("FPIRHC_CC", "none")
    code = main(["export", *words, *([] if "--out" in words else ["--out", "new"])])
    assert capsys.readouterr().err == f"fpirhc: {ROWS[row]}\n"
    assert code == (3 if "full" in words else 2)
    assert not (tmp_path / "new").exists()
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["mine.txt"]


def test_a_compiler_that_does_not_work_is_named_and_no_folder(tmp_path, monkeypatch, capsys):
    """One whose interpreter is not there cannot be started, which is no fault of the folder."""
    path = tmp_path / "broken"
    path.write_text("#!/no/such/interpreter\n")
    path.chmod(0o700)
    monkeypatch.setenv("FPIRHC_CC", str(path))
    monkeypatch.chdir(tmp_path)
    assert main(["export", "two_mass", "CTC+FPI (eq 6)", "--to", "library", "--out", "new"]) == 2
    assert f"'{path}' cannot be started: No such file or directory" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
