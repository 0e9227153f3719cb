"""A metric of a problem file's own: one value, and every table, file, scenario, baseline and notebook has it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from blessed import LINE

import fpirhc as fp
from fpirhc.baselines.check import accept
from fpirhc.cli.main import main
from fpirhc.simulation.metrics import base, entries

OWN = '''

def largest_lead(problem, run):
    """How far the plant is ahead of its reference at most, by coordinate."""
    late = run.time >= problem.measure_from
    return {c: float(max(0.0, (-run[f"true_error.{c}"][late]).max())) for c in run.layout["error"].elements}


def share_inside(problem, run):
    """Share of the cycles with an error below 1 mm."""
    return float((abs(run["true_error"]).max(axis=1) < 1e-3).mean())


metrics = (
    fp.Metric("largest_lead", largest_lead, by="coordinate", unit="m", headline=True),
    fp.Metric("share_inside", share_inside, better="larger", headline=True),
)
controllers.pop("RHC+FPI")
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the problem file."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "line.py").write_text(LINE + OWN)
    return folder


@pytest.fixture
def task(folder, monkeypatch):
    """The loaded problem file, with its folder as the current one."""
    monkeypatch.chdir(folder)
    return fp.load_problem("line.py")


def test_json_terminal_and_report_have_it(task, capsys):
    """The same number everywhere, measured from the run itself."""
    assert main(["compare", "line.py", "--json", "--no-compile", "--out", "out"]) == 0
    facts = json.loads(capsys.readouterr().out)["controllers"]["CTC"]
    run = fp.simulate(task.problem, task.controllers["CTC"], seed=0, compiled=False)
    lead = float(np.max(-run["true_error"][run.time >= task.problem.measure_from]))
    assert lead > 0.01
    assert facts["largest_lead"] == {"y": pytest.approx(lead)}
    assert 0 <= facts["share_inside"] <= 1
    page = Path("out/report.html").read_text()
    assert "<th scope='col'>largest lead y [m]</th><th scope='col'>share inside</th>" in page
    assert f"{lead:.3g}</td>" in page
    assert "Marked are the best of: rms error, contraction predicted, largest lead, share inside." in page
    assert main(["compare", "line.py", "--no-compile", "--out", "out"]) == 0
    assert "lead" in capsys.readouterr().out
    assert main(["run", "line.py", "CTC", "--no-compile", "--out", "out"]) == 0
    assert f"largest lead y [m]: {lead:.3g}" in capsys.readouterr().out


def test_scenarios_have_it(task, tmp_path):
    """In the ledger of every scenario, and as a median; where more is better the ones without it are the worst."""
    study = fp.compare_scenarios(task, count=3, percent=10.0, seed=1, folder=tmp_path, compiled=False)
    lines = [json.loads(line) for line in (tmp_path / "scenarios.jsonl").read_text().splitlines()[1:]]
    leads = [r["metrics"]["largest_lead"]["y"] for r in lines if r["controller"] == "CTC"]
    assert len(set(leads)) == 3
    assert study["CTC"].metrics["largest_lead"]["y"] == pytest.approx(np.median(leads))
    assert [c.short for c in study.columns][-2:] == ["largest lead y [m]", "share inside"]
    broken = replace(task, metrics=[*task.metrics, fp.Metric("mine", lambda problem, run: 1 / 0)])
    told = fp.compare_scenarios(
        broken, count=1, percent=9.0, seed=1, folder=tmp_path / "broken", compiled=False
    ).verdict
    assert told[-1] == "No run has metric 'mine'; where its function raises, fpirhc run tells why."
    with pytest.raises(fp.FpirhcError, match="results are never mixed: metrics was"):
        fp.compare_scenarios(
            replace(task, metrics=task.metrics[:-1]), count=3, percent=10.0, seed=1, folder=tmp_path, compiled=False
        )


def test_baselines_have_it(task, folder):
    """Blessed, it holds; leaving the band upwards is better where more is better; an unknown name is answered."""
    told: list[tuple[str, int, int]] = []
    baseline, path = accept(task, "first", compiled=False, working=folder, progress=lambda *one: told.append(one))
    assert [done for _, done, _ in told] == list(range(told[0][2] + 1)), "from before the first run to the last"
    metrics = baseline.controllers["CTC"].metrics
    assert {"largest_lead.y", "share_inside"} <= set(metrics)
    assert fp.check_baseline(task, compiled=False).holds
    file = folder / "line.py"
    file.write_text(file.read_text().replace("< 1e-3", "< 1.0"))
    changed = {row.metric: row.verdict for row in fp.check_baseline(fp.load_problem("line.py"), compiled=False).changed}
    assert changed == {"share_inside": "better"}
    file.write_text(file.read_text().replace('Metric("share_inside"', 'Metric("share_in"'))
    refused = fp.check_baseline(fp.load_problem("line.py"), compiled=False)
    assert "Did you mean 'share_in'" in refused.unusable[0]
    file.write_text(LINE + OWN)
    path.unlink()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("metrics = ('overshoot',)", r"metrics must be a sequence of fpirhc\.Metric"),
        ("headline_metric = 'rms_eror.y'", r"line \d+: metric 'rms_eror.y' is unknown\. Did you mean 'rms_error'"),
    ],
)
def test_a_problem_file_with_something_else_is_refused(text, message, tmp_path):
    (tmp_path / "line.py").write_text(f"{LINE}\n{text}\n")
    with pytest.raises(fp.FpirhcError, match=message):
        fp.load_problem(str(tmp_path / "line.py"))


def test_a_shipped_metric_is_one_file(tmp_path, monkeypatch):
    """A file in the folder is found, and nothing else has to know of it."""
    (tmp_path / "peak.py").write_text(
        "from fpirhc.simulation.metrics.base import Metric\nMETRICS = (Metric('peak', lambda problem, run: 1.0),)\n"
    )
    monkeypatch.setattr(entries, "__path__", [*entries.__path__, str(tmp_path)])
    assert "peak" in [metric.name for metric in base.known_metrics.__wrapped__()]
