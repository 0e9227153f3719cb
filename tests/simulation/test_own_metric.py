"""A metric of a problem file's own: one value, and every table, file, scenario, baseline and notebook has it."""

from __future__ import annotations

import pytest
from helpers.blessed import LINE

import fpirhc as fp
from fpirhc.simulation.metrics import base, entries


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("metrics = ('overshoot',)", r"line \d+: metrics\[0\]: expected a Metric, got the text 'overshoot'"),
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
