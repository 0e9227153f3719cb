"""Full disks, damaged ledgers and Ctrl-C: one line, a code of its own, and what is finished is kept."""

from __future__ import annotations

import json
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import casadi as ca
import numpy as np
import pytest
from test_scenarios import LINE

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.cli.verb import ExitCode
from fpirhc.contraction import spectrum
from fpirhc.controllers.live_settings import live_settings
from fpirhc.errors import NotSupported
from fpirhc.studies.scenarios.ledger import Ledger
from fpirhc.symbolic.evaluate import Evaluator, attempted

COMMAND = (
    "compare",
    "line.py",
    "--scenarios",
    "3",
    "--mismatch",
    "20",
    "--no-compile",
    "--controllers",
    "CTC",
    "CTC+FPI",
)
PLANNED = """measure_from=0.5,
    horizon=fp.Horizon(stages=30, step=5e-3),
    cost=fp.Quadratic(states={'y': 1.0}, deviation={'u': 1e-3}),"""
LONG = LINE.replace("measure_from=0.5,", PLANNED).replace(
    "controllers = {", "controllers = {\n    'RHC': fp.RecedingHorizon(fp.Ipopt()),"
)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """An empty working folder with a problem."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "line.py").write_text(LINE)
    return tmp_path


@contextmanager
def room(size: int) -> Iterator[None]:
    """Files may grow to `size` bytes; the system cuts a longer write off and refuses the next, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def interrupted_once(begun: Callable[[], object], *, every: float = 0.05) -> Iterator[None]:
    """A signal that is answered as Ctrl-C is, wherever the program is at the first tick at which `begun` is true."""

    def interrupt(number: int, frame: object) -> None:
        if begun():
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, every, every)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def test_a_full_disk_is_one_line_and_the_same_command_continues_to_the_same_results(folder, capsys):
    ledger = Path("out/scenarios.jsonl")
    assert main([*COMMAND, "--out", "whole"]) == ExitCode.FINISHED
    whole = Path("whole/scenarios.jsonl").read_bytes()
    capsys.readouterr()
    ends = [k for k, byte in enumerate(whole) if byte == ord("\n")]
    with room(ends[2] + 40):  # the header, two records and a torn third
        assert main([*COMMAND, "--out", "out"]) == ExitCode.NOT_WRITABLE
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert "cannot write to 'out/scenarios.jsonl'" in said[0]
    assert "the same command continues from them" in said[0]
    assert len(ledger.read_bytes()) == ends[2] + 40
    assert main([*COMMAND, "--out", "out"]) == ExitCode.FINISHED
    assert ledger.read_bytes() == whole


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: {k: v for k, v in r.items() if k != "scenario"}, "needs scenario"),
        (lambda r: {k: v for k, v in r.items() if k != "metrics"}, "needs metrics"),
        (lambda r: {**r, "scenario": "1"}, "scenario: expected a whole number of at least 0, got the text '1'"),
        (lambda r: {**r, "error": [1]}, "error: expected a number or None"),
    ],
)
def test_a_record_that_lacks_a_field_is_refused_by_name(change, message, folder, capsys):
    assert main([*COMMAND, "--out", "out"]) == ExitCode.FINISHED
    capsys.readouterr()
    ledger = Path("out/scenarios.jsonl")
    lines = ledger.read_text().splitlines()
    lines[2] = json.dumps(change(json.loads(lines[2])))
    ledger.write_text("\n".join(lines) + "\n")
    assert main([*COMMAND, "--out", "out"]) == ExitCode.NOT_WRITABLE
    said = " ".join(capsys.readouterr().err.split())
    assert "scenarios.jsonl', line 3 is damaged" in said
    assert message in said
    assert "Traceback" not in said


class _Interrupts(ca.Callback):
    """Ctrl-C in the middle of a Function."""

    def __init__(self) -> None:
        ca.Callback.__init__(self)
        self.construct("interrupts", {})

    def eval(self, arguments):
        signal.raise_signal(signal.SIGALRM)
        return [arguments[0]]


@pytest.mark.parametrize(
    "asked",
    [lambda e: e.failure(), lambda e: e(1.0), lambda e: attempted("part", e.function, 1.0, broken=[])],
    ids=["failure", "call", "part of a result"],
)
def test_an_interruption_between_two_operations_is_an_interruption(asked):
    """CasADi reports it as a RuntimeError, which looks like a solver that failed: a run would end early."""
    x, interrupts = ca.MX.sym("x"), _Interrupts()
    evaluator = Evaluator(ca.Function("f", [x], [interrupts(x)]))
    with interrupted_once(lambda: True, every=3600.0), pytest.raises(KeyboardInterrupt):
        asked(evaluator)


@pytest.mark.parametrize("every", [0.003, 0.01, 0.05])
def test_an_interruption_inside_a_solver_is_an_interruption(every, folder):
    """IPOPT catches it and goes on, and CasADi reports it as a SystemError, which would be taken for a fault of the program.

    The run is interrupted after its first report, and no machine solves the rest of its 100 000 plans before the next tick.
    """
    (folder / "long.py").write_text(LONG)
    task = fp.load_problem("long.py")
    long = replace(task.problem, duration=500.0)
    reports: list[int] = []

    def run() -> None:
        ended = fp.simulate(
            long, task.controllers["RHC"], seed=0, compiled=False, progress=lambda cycle, _: reports.append(cycle)
        )
        pytest.fail(f"the run ended after {ended.cycles} of {long.cycles} cycles and not as interrupted: {ended.stop}")

    with interrupted_once(lambda: reports, every=every), pytest.raises(KeyboardInterrupt):
        run()


def test_an_interruption_of_a_stepper_is_no_failed_solver(folder, monkeypatch):
    """A failed solver holds the command; an interruption goes to the caller, whichever error CasADi makes of it."""
    task = fp.load_problem("line.py")
    wrapped = SystemError("a result with an exception set")
    wrapped.__cause__ = KeyboardInterrupt()
    for error, expected in [
        (RuntimeError("KeyboardInterrupt"), KeyboardInterrupt),
        (wrapped, KeyboardInterrupt),
        (SystemError("a fault"), SystemError),
    ]:
        stepper = fp.Stepper(task.problem, task.controllers["CTC"], compiled=False)
        raising = Mock(side_effect=error)
        monkeypatch.setattr(stepper, "_evaluate", raising)
        with pytest.raises(expected):
            stepper.step(0.0, np.zeros(2), np.zeros(1), stepper.start())
        assert raising.called


def test_ctrl_c_in_scenarios_keeps_what_is_finished(folder, capfd):
    (folder / "long.py").write_text(LONG)
    words = ["compare", "long.py", "--scenarios", "1000", "--mismatch", "20", "--no-compile", "--out", "out"]

    def records() -> bool:
        """Whether results are there to be kept, and a solver is at work."""
        ledger = Path("out/scenarios.jsonl")
        return ledger.exists() and ledger.read_bytes().count(b"\n") > 3

    with interrupted_once(records):
        assert main([*words, "--controllers", "CTC", "RHC"]) == ExitCode.INTERRUPTED
    said = capfd.readouterr().err
    assert "finished results are kept in out/scenarios.jsonl" in said
    assert "Traceback" not in said
    finished = Path("out/scenarios.jsonl").read_text().splitlines()
    assert 4 <= len(finished) < 2000
    assert all(json.loads(line)["controller"] in ("CTC", "RHC") for line in finished[1:])
    assert main([*words[:3], "1", *words[4:], "--controllers", "CTC"]) == ExitCode.FINISHED
    assert Path("out/scenarios.jsonl").read_text().splitlines()[: len(finished)] == finished


@pytest.mark.parametrize(
    "words",
    [
        ("limits", "line.py", "--over", "mismatch", "lost"),
        ("robust", "line.py", "--risk", "0.5", "--confidence", "0.9"),
    ],
    ids=lambda words: words[0],
)
def test_ctrl_c_in_a_search_keeps_what_is_finished(words, folder, capsys, monkeypatch):
    """What was kept is not computed again, and the result is that of a search that was not interrupted."""
    command, told, most = [*words, "--no-compile", "--controllers", "CTC", "CTC+FPI", "--out"], [], [1000]
    append = Ledger.append

    def appended(ledger: Ledger, record: dict[str, object]) -> None:
        append(ledger, record)
        told.append(record)
        if len(told) == most[0]:
            raise KeyboardInterrupt

    monkeypatch.setattr(Ledger, "append", appended)
    assert main([*command, "whole"]) == ExitCode.FINISHED
    whole, most[0] = list(told), len(told) - 3
    told.clear()
    assert main([*command, "out"]) == ExitCode.INTERRUPTED
    assert f"finished results are kept in out/{words[0]}.jsonl" in capsys.readouterr().err
    assert main([*command, "out"]) == ExitCode.FINISHED
    assert told == whole
    assert (folder / "out/results.json").read_text() == (folder / "whole/results.json").read_text()


class _Raising(ca.Callback):
    """A Function of a user's own that raises where it is evaluated."""

    def __init__(self, error: BaseException) -> None:
        ca.Callback.__init__(self)
        self.error = error
        self.construct("raising", {})

    def get_n_in(self) -> int:
        return 4

    def eval(self, _: object) -> list[float]:
        raise self.error


@pytest.mark.parametrize(
    ("error", "expected", "words"),
    [(ZeroDivisionError("of my own"), RuntimeError, "of my own"), (KeyboardInterrupt(), KeyboardInterrupt, None)],
    ids=["own error", "interruption"],
)
def test_a_solver_that_gives_up_hides_no_other_error(error, expected, words, monkeypatch):
    """Response Jacobians are not finite where Newton's method has no derivative; an error of the equations is raised."""
    plant = fp.load_problem("two_mass").problem.plant
    row = (np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)), np.zeros(1))
    raising = _Raising(error)
    monkeypatch.setattr(spectrum, "response_jacobian", lambda plant: raising)
    with pytest.raises(expected, match=words):
        spectrum.response_jacobians(plant, *row)
    z, p = ca.MX.sym("z"), ca.MX.sym("p")
    root = ca.rootfinder("root", "fast_newton", ca.Function("f", [z, p], [z**2 - p]))
    unsolved = ca.Function("unsolved", [*(ca.MX.sym(n) for n in "abc"), p], [ca.jacobian(root(0.0, p), p)])
    monkeypatch.setattr(spectrum, "response_jacobian", lambda plant: unsolved)
    assert np.isnan(spectrum.response_jacobians(plant, *row)).all()


def test_an_interruption_while_a_loop_with_live_settings_is_built_is_no_setting_that_cannot_be_live():
    task = fp.load_problem("two_mass")
    live = live_settings(task.problem, task.controllers["CTC"], ["tracking.rate"])
    with pytest.raises(KeyboardInterrupt):
        live.composed(Mock(side_effect=RuntimeError("in a solver: KeyboardInterrupt")))
    with pytest.raises(NotSupported, match="of my own"):
        live.composed(Mock(side_effect=RuntimeError("of my own")))
