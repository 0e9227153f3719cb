"""Baselines of an older version: their names are read as those of today, their numbers are not touched."""

from __future__ import annotations

from dataclasses import replace

from blessed import write_problems

import fpirhc as fp
from fpirhc.baselines.bands import Expected, Metric
from fpirhc.baselines.baseline import Settings, to_text
from fpirhc.baselines.reading import new_metrics, new_settings, read_baseline

OLD_NAMES = {"cost.deviation": "cost.correction", "replanning.": "nominal.", "optimiser.hessian": "optimiser.bend"}
OLD_CLASSES = {"FromMeasurement": "Restart"}


def old(name: str) -> str:
    for now, before in OLD_NAMES.items():
        name = name.replace(now, before)
    return name


def old_settings(flat):
    return {old(k): OLD_CLASSES.get(v, v) if isinstance(v, str) else v for k, v in flat.items()}


def test_an_old_baseline_holds_and_says_what_is_renamed(tmp_path):
    """A file with the names of before: every number is compared, nothing is stale, and the names are told."""
    write_problems(tmp_path)
    task = fp.load_problem(str(tmp_path / "line.py"))
    path = tmp_path / "baselines" / "line.json"
    today = read_baseline(path)
    assert not today.renamed
    settings = Settings(
        old_settings(today.settings.problem), {n: old_settings(one) for n, one in today.settings.controllers.items()}
    )
    controllers = {
        name: replace(one, metrics={old(k): m for k, m in one.metrics.items()})
        for name, one in today.controllers.items()
    }
    path.write_text(to_text(replace(today, settings=settings, controllers=controllers)))
    assert "cost.correction" in path.read_text()
    judgement = fp.check_baseline(task, compiled=False)
    assert judgement.holds, (judgement.unusable, judgement.changed)
    note = next(n for n in judgement.notes if "older version" in n)
    for before, now in (
        ("cost.correction", "cost.deviation"),
        ("Restart", "FromMeasurement"),
        ("nominal", "replanning"),
    ):
        assert f"'{before}' is now '{now}'" in note
    # Once accepted again, the file has the names of today.
    assert read_baseline(path).renamed
    path.write_text(to_text(replace(read_baseline(path), renamed={})))
    assert not read_baseline(path).renamed


def test_names_of_a_users_own_stay():
    """A coordinate may be called like an old setting; a value is a class only where 'is' says so."""
    mine = {"start.nominal": 1.0, "cost.states.correction": 2.0, "reference.function": "Restart", "limits.bend": 3.0}
    renamed, changed = new_settings(Settings(mine, {"RHC": mine}))
    assert renamed == Settings(mine, {"RHC": mine})
    assert not changed


def test_what_is_not_compared_is_renamed_too():
    """Under its new name, with the reason."""
    some = Expected(("finished",), {"cost.total": Metric("banded", 1.0, 0.1, {})}, {"cost.correction": "why"})
    renamed, changed = new_metrics(some)
    assert renamed.not_compared == {"cost.deviation": "why"}
    assert changed == {"cost.correction": "cost.deviation"}
