"""Rows of a study are kept: killed processes, clusters and an interruption end in the rows of one calm process."""

import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import joblib
import pandas as pd
import pytest
from helpers.line import line_text

import fpirhc as fp
from fpirhc.errors import InvalidProblem, OutputError, WorkerDied

LINE = line_text("period=5e-3, duration=1.5, measure_from=0.5, disturbances={'u': fp.Noise(0.1)}", bounds="(0.5, 2.4)")
# A controller that kills the process which builds it a second time: the first one stands in a file beside the problem.
DEADLY = """
from pathlib import Path
from typing import Any
import os, signal

class Deadly(fp.ComputedTorque):
    def check(self, problem):
        here = Path(__file__).parent
        if (here / "armed").exists():
            (here / "armed").unlink()
            os.kill(os.getpid(), signal.SIGKILL)

controllers["deadly"] = Deadly(tracking)
"""
DRAWS = fp.Draws(12, 20.0, 5)


@pytest.fixture
def task(tmp_path, monkeypatch) -> Any:
    """The task in a file of its own, in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    Path("line.py").write_text(LINE)
    return fp.load_problem("line.py")


def rows(task: Any, variants: Any, **settings: Any) -> pd.DataFrame:
    return fp.study(task, variants, compiled=False, **settings).table


def kept(path: str = "kept/runs.jsonl") -> list[str]:
    return Path(path).read_text().splitlines()


def same(one: pd.DataFrame, other: pd.DataFrame) -> None:
    pd.testing.assert_frame_equal(one, other, check_exact=True)
    assert one.attrs == other.attrs


def test_what_is_kept_is_not_run_again(task):
    """A torn line is run again; more plants and other controllers of the same study go on from it, and its rows stay."""
    whole = rows(task, DRAWS, folder=Path("kept"))
    lines = kept()
    assert len(lines) == 1 + 24
    Path("kept/runs.jsonl").write_text("\n".join(lines[:7]) + "\n" + lines[7][:40])
    told: list[str] = []
    again = rows(task, DRAWS, folder=Path("kept"), progress=lambda name, done, of: told.append(name))
    same(again, whole)
    assert len(told) == 24 - 6
    before = kept()
    more = rows(task, fp.Draws(15, 20.0, 5), controllers=["CTC"], folder=Path("kept"))
    assert kept()[: len(before)] == before
    assert len(kept()) == len(before) + 3
    same(more.iloc[:12], whole.iloc[:12])
    told.clear()
    same(rows(task, DRAWS, folder=Path("kept"), progress=lambda name, done, of: told.append(name)), whole)
    assert not told


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda task: (task, fp.Draws(12, 10.0, 5)), "mismatch was 20.0, is 10.0"),
        (lambda task: (task, fp.Draws(12, 20.0, 6)), "seed was 5, is 6"),
        (lambda task: (replace(task, problem=replace(task.problem, duration=1.0)), DRAWS), "problem was "),
        (
            lambda t: (replace(t, controllers=t.controllers | {"CTC": t.controllers["CTC+FPI"]}), DRAWS),
            "controller 'CTC' was ",
        ),
    ],
)
def test_rows_of_another_study_are_never_mixed(change, says, task):
    rows(task, DRAWS, controllers=["CTC"], folder=Path("kept"))
    before = kept()
    other, variants = change(task)
    with pytest.raises(OutputError, match=rf"rows of another study \(.*{says}.*--out"):
        rows(other, variants, folder=Path("kept"))
    assert kept() == before
    Path("kept/runs.jsonl").write_text("no study\n")
    with pytest.raises(OutputError, match="holds no rows of a study"):
        rows(task, DRAWS, folder=Path("kept"))


def test_processes_change_nothing(task):
    """Nor does the number of plants in a job; another task than that of the file is refused, because they load the file."""
    same(rows(task, DRAWS, processes=2), rows(task, DRAWS))
    changed = replace(task, problem=replace(task.problem, duration=1.0))
    with pytest.raises(InvalidProblem, match=r"is not that of .*line.py', which other processes load"):
        rows(changed, DRAWS, processes=2)


def test_a_killed_process_is_told_and_the_same_call_goes_on(task):
    """No row is lost, doubled or changed."""
    Path("line.py").write_text(LINE + DEADLY)
    deadly = fp.load_problem("line.py")
    whole = rows(deadly, DRAWS)
    Path("armed").touch()
    with pytest.raises(WorkerDied, match="the same call goes on"):
        rows(deadly, DRAWS, processes=2, folder=Path("kept"))
    assert not Path("armed").exists()
    same(rows(deadly, DRAWS, processes=2, folder=Path("kept")), whole)
    done = [json.loads(line) for line in kept()[1:]]
    assert len({(row["controller"], row["variant"]) for row in done}) == len(done) == 36


@pytest.mark.slow
def test_a_cluster_of_dask_gives_the_rows_of_one_process(task):
    """Two workers, one of which is killed on the way: Dask gives its jobs to others."""
    distributed = pytest.importorskip("distributed", reason="Dask is not installed")
    whole = rows(task, DRAWS)
    killed: list[int] = []
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as local,
        distributed.Client(local),
        joblib.parallel_config(backend="dask"),
    ):

        def kill(name: str, done: int, of: int) -> None:
            del name, done, of
            workers = [one.process.pid for one in local.workers.values() if one.process is not None]
            if not killed and workers:
                killed.append(workers[0])
                os.kill(workers[0], signal.SIGKILL)

        same(rows(task, DRAWS), whole)
        assert not Path("kept/runs.jsonl").exists()
        same(rows(task, DRAWS, folder=Path("kept"), progress=kill), whole)
    assert killed
    assert len(kept()) == 1 + 24


@pytest.mark.parametrize("processes", ["2", pytest.param("1", marks=pytest.mark.slow)])
def test_ctrl_c_keeps_what_is_finished_and_the_same_command_goes_on(task, processes):
    """The command is interrupted once rows are there, with its processes, as a terminal does it: code 130 and one line."""
    words = ["study", "line.py", "--draws", "15", "--mismatch", "20", "--seed", "5", "--no-compile", "--json"]
    command = [sys.executable, "-m", "fpirhc", *words, "--out", "out", "--processes", processes]
    long = LINE.replace("duration=1.5", "duration=20.0")
    Path("line.py").write_text(long)
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen(command, **pipes) as process:
        while process.poll() is None and (not Path("out/runs.jsonl").exists() or len(kept("out/runs.jsonl")) < 4):
            with suppress(subprocess.TimeoutExpired):
                process.wait(0.02)
        os.killpg(process.pid, signal.SIGINT)
        said = process.communicate()[1]
    assert process.returncode == 130, said
    assert said.splitlines()[-1] == "fpirhc: interrupted; what is finished is kept, and the same command goes on"
    finished = kept("out/runs.jsonl")
    assert 4 <= len(finished) < 31
    task = fp.load_problem("line.py")
    again = rows(task, fp.Draws(15, 20.0, 5), folder=Path("out"))
    assert kept("out/runs.jsonl")[: len(finished)] == finished
    same(again, rows(task, fp.Draws(15, 20.0, 5)))


def test_limits_that_were_found_are_not_searched_again(task):
    """An interruption between two of them costs the one that was searched."""
    facts = {"over": ["mismatch", "lost"], "controllers": ["CTC", "CTC+FPI"], "compiled": False}
    whole = fp.margins(task, **facts, folder=Path("whole"))

    def interrupt(name: str, done: int, of: int) -> None:
        if name == "CTC+FPI" and done < of:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fp.margins(task, **facts, folder=Path("out"), progress=interrupt)
    assert len(kept("out/margins.jsonl")) == 1 + 3
    pd.testing.assert_frame_equal(fp.margins(task, **facts, folder=Path("out")).table, whole.table)
    assert kept("out/margins.jsonl") == kept("whole/margins.jsonl")
