"""Scenarios on a cluster of Dask: the same records, bit by bit, whoever dies on the way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.errors import FpirhcError, InvalidValue, NotSupported, WorkerDied
from fpirhc.studies.scenarios import cluster
from fpirhc.studies.scenarios.bench import Conditions
from fpirhc.studies.scenarios.cluster import Cluster, run_jobs
from fpirhc.studies.scenarios.draws import COMPARING
from fpirhc.studies.scenarios.fingerprint import fingerprint
from fpirhc.studies.scenarios.scenario_study import LEDGER, compare_scenarios

dask = pytest.importorskip("dask", reason="the extra 'cluster' is not installed")
distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
NAMES = ["CTC", "CTC+FPI (eq 6)"]


@pytest.fixture(scope="module")
def two_workers() -> Iterator[Any]:
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as local:
        yield local


def studied(folder: Path, count: int = 12, **settings: Any) -> dict[tuple[int, str], str]:
    """The records of a study by scenario and controller, as they stand in its ledger; none may stand there twice."""
    task = fp.load_problem("two_mass")
    compare_scenarios(
        task, count=count, percent=20.0, seed=3, folder=folder, controllers=NAMES, compiled=False, **settings
    )
    lines = (folder / LEDGER).read_text().splitlines()[1:]
    records = [json.loads(line) for line in lines]
    found = {(r["scenario"], r["controller"]): line for r, line in zip(records, lines, strict=True)}
    assert len(found) == len(lines)
    return found


def opening_of(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a worker is told, and the facts that it must find."""
    conditions = Conditions(3, COMPARING, 20.0, False)
    task = fp.load_problem("two_mass")
    opening = {"path": str(path), "tuned": {}, "conditions": asdict(conditions)}
    return opening, fingerprint(task, conditions)


def test_a_cluster_gives_the_records_of_one_process(tmp_path: Path, two_workers: Any) -> None:
    alone = studied(tmp_path / "alone")
    assert studied(tmp_path / "together", cluster=two_workers.scheduler_address) == alone


@pytest.mark.parametrize(("kills", "borne"), [(3, 3), (2, 0), pytest.param(30, 3, marks=pytest.mark.slow)])
def test_workers_that_are_killed_lose_and_double_nothing(tmp_path: Path, kills: int, borne: int) -> None:
    """One of two, after every third record; also a task that Dask gives up when so many of its workers have died is given again."""
    killed: list[int] = []
    alone = studied(tmp_path / "alone", 4 * kills)

    def kill(name: str, done: int, total: int) -> None:
        del name, total
        workers = [one.process.pid for one in local.workers.values() if one.process is not None]
        if done % 3 == 0 and len(killed) < kills and workers:
            killed.append(workers[0])
            os.kill(killed[-1], signal.SIGKILL)

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": borne}),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as local,
    ):
        together = studied(tmp_path / "together", 4 * kills, cluster=local.scheduler_address, progress=kill)
    assert len(killed) > kills // 2
    assert together == alone


def test_a_scheduler_that_dies_ends_the_study_and_the_next_one_goes_on(tmp_path: Path) -> None:
    """What was finished stands in the ledger; without a cluster the same study runs the rest."""
    code = (
        "import distributed, sys\n"
        "if __name__ == '__main__':\n"
        "    local = distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address='127.0.0.1:0')\n"
        "    print(local.scheduler_address, flush=True)\n"
        "    sys.stdin.read()\n"
    )
    script = tmp_path / "scheduler.py"
    script.write_text(code)
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([sys.executable, str(script)], text=True, **pipes) as process:  # type: ignore[call-overload]
        address = process.stdout.readline().strip()
        with pytest.raises(WorkerDied, match="finished results are kept, and the same command continues from them"):
            studied(tmp_path / "study", cluster=address, progress=lambda *_: process.kill())
    assert studied(tmp_path / "study") == studied(tmp_path / "alone")


def test_a_worker_with_another_compiler_is_refused(
    tmp_path: Path, two_workers: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fpirhc.studies.scenarios.fingerprint.machine_facts", lambda: {"compiler": "cc 1.0"})
    with pytest.raises(
        FpirhcError, match=r"a worker would compute other numbers: compiler is .* there and 'cc 1.0' here"
    ):
        studied(tmp_path, cluster=two_workers.scheduler_address)


def test_a_worker_without_the_file_has_its_content(tmp_path: Path) -> None:
    path = fp.load_problem("two_mass").path
    elsewhere, greeting = opening_of(tmp_path / "two_mass.py")
    here, _ = opening_of(path)
    content = path.read_bytes()
    records = [run_jobs(json.dumps(o), content, greeting, [[([0], "CTC")]])[0] for o in (elsewhere, here)]
    assert records[0] == records[1]
    assert records[0][0][0]["outcome"] == "finished"


def test_a_file_that_a_worker_cannot_load_is_named(tmp_path: Path) -> None:
    opening, greeting = opening_of(tmp_path / "none.py")
    [[answer]], _ = run_jobs(json.dumps(opening), b"import nowhere_at_all\n", greeting, [[([0], "CTC")]])
    assert answer["error"].startswith("a worker cannot load the problem: ")
    assert "nowhere_at_all" in answer["error"]


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense", "", "http://127.0.0.1:8786"])
def test_an_address_that_does_not_answer_is_named(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_WAIT", 0.5)
    opening, greeting = opening_of(fp.load_problem("two_mass").path)
    with pytest.raises(InvalidValue, match=rf"--cluster {address}: no scheduler answers there"):
        Cluster(address, opening, greeting, 1)


def test_a_cluster_without_workers_is_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A warning, because workers may come yet; warnings are errors here."""
    monkeypatch.setattr(cluster, "_WAIT", 0.5)
    with distributed.LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0") as local:
        address = local.scheduler_address
        with pytest.raises(RuntimeWarning, match=f"the cluster at {address} has no workers; .*: dask worker {address}"):
            studied(tmp_path, cluster=address)


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    opening, greeting = opening_of(fp.load_problem("two_mass").path)
    with pytest.raises(NotSupported, match=r"--cluster needs distributed, .* pip install 'fpirhc\[cluster\]'"):
        Cluster("local", opening, greeting, 1)


def test_a_cluster_is_for_scenarios(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "two_mass", "--cluster", "local"]) == 2
    assert "--cluster needs --scenarios N" in capsys.readouterr().err
