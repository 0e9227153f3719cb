"""A package of somebody else adds one member of each kind, one file each, and everything works with them."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = {
    "clipped": ("A map", "EXAMPLES = (Clipped(gain=0.3, limit=5.0),)"),
    "poles": ("A tracking law", "EXAMPLES = (Poles(rate=2.0),)"),
    "projected_gradient": ("An optimiser", "EXAMPLES = (ProjectedGradient(iterations=100, tolerance=1e-6),)"),
    "gradient": ("An estimator of parameters", 'EXAMPLES = (Gradient("m", gain=0.02, largest=0.6),)'),
    "observer": ("An observer of states", 'EXAMPLES = (Observer({"a": {"a": 0.3}, "b": {"b": 0.3}}),)'),
    "saturated": ("A controller", "EXAMPLES = (Saturated(6.0, 20.0),)"),
}
MEMBERS = {
    "deformations": "Clipped",
    "tracking laws": "Poles",
    "optimisers": "ProjectedGradient",
    "estimators": "Gradient",
    "controllers": "Saturated",
    "observers": "Observer",
}
# Two wrappers in each other, neither of them known to fpirhc: a controller whose user wants to name it.
NAMED = '''
"""A controller under another name."""
from dataclasses import dataclass

from fpirhc.contracts import Controller


@dataclass(frozen=True)
class Named(Controller):
    """The inner controller, unchanged."""

    controller: Controller
    title: str

    @property
    def inner(self):
        return self.controller

    @property
    def deformation(self):
        return self.controller.deformation

    def blocks(self, built):
        return self.controller.blocks(built)


def examples(inner):
    return (Named(inner, "one"),)
'''
PROBLEM = '''
"""Two masses served by members from abroad."""
from dataclasses import replace

import fpirhc as fp
from abroad.clipped import Clipped
from abroad.gradient import Gradient
from abroad.named import Named
from abroad.poles import Poles
from abroad.saturated import Saturated

task = fp.load_problem("two_mass")
problem = replace(task.problem, duration=1.0, measure_from=0.5)
planned = fp.RecedingHorizon(fp.FixedPointSolver(iterations=1, tolerance=1e-2))
controllers = {
    "poles": fp.ComputedTorque(Poles(rate=6.0)),
    "poles+clipped": fp.ComputedTorque(Poles(rate=6.0), Clipped(gain=0.2, limit=5.0)),
    "saturated+FPI": Saturated(6.0, 20.0, fp.Sigmoid(gain=-0.5)),
    "learner": fp.Estimating(fp.ComputedTorque(Poles(rate=6.0)), Gradient("m1", gain=0.02, largest=0.6)),
    "RHC": Named(Named(planned, "inside"), "outside"),
}
headline = ("poles", "poles+clipped")
'''


@pytest.fixture(scope="module")
def abroad(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package `abroad`, installed as a distribution with an entry point, and a problem that uses it."""
    folder = tmp_path_factory.mktemp("site")
    package = folder / "abroad"
    package.mkdir()
    (package / "__init__.py").write_text('"""Members from abroad."""\n')
    (package / "named.py").write_text(NAMED)
    text = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    sections = {part.partition("\n")[0]: part for part in text.split("\n## ")}
    for module, (title, examples) in PAGES.items():
        [code, *_] = re.findall(r"```python\n(.*?)```", sections[title], re.DOTALL)
        (package / f"{module}.py").write_text(f'"""From the section {title}."""\n{code}\n\n{examples}\n')
    facts = folder / "abroad-1.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: abroad\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text("[fpirhc.members]\nabroad = abroad\n")
    (folder / "masses.py").write_text(PROBLEM)
    return folder


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own, with the package on the path."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)]), "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def test_members_from_abroad_are_found_and_keep_the_laws(abroad: Path) -> None:
    """Every family lists them, `fp.NAME` finds them by their file, the laws try their examples."""
    script = (
        "import json; import fpirhc as fp; from fpirhc.conformance import FAMILIES, examples, member_classes\n"
        "from fpirhc.conformance import check_deformation, check_optimiser, check_tracking\n"
        "mine = lambda f: [e for e in examples(f) if type(e).__module__.startswith('abroad')]\n"
        "[check_deformation(m, seed=1) for m in mine('deformations')]\n"
        "[check_tracking(m, seed=1, period=2e-3, duration=6.0) for m in mine('tracking laws')]\n"
        "[check_optimiser(m, tolerance=1e-6, seed=1) for m in mine('optimisers')]\n"
        "families = {f: [c.__name__ for c in member_classes(f)] for f in FAMILIES}\n"
        "print(json.dumps([families, [len(mine(f)) for f in families], fp.Poles.__module__, fp.Named.__module__]))"
    )
    answer = run(abroad, "-c", script)
    assert answer.returncode == 0, answer.stderr
    families, counts, *modules = json.loads(answer.stdout)
    assert modules == ["abroad.poles", "abroad.named"]
    assert {family for family, count in zip(families, counts, strict=True) if count} >= {*MEMBERS}
    for family, name in MEMBERS.items():
        assert name in families[family]
    assert "Named" in families["controllers"]


COMPARED = """import json; import fpirhc as fp; found = fp.compare(fp.load_problem("masses.py"), seed=0, compiled=False)
print(json.dumps({e.name: [e.errors["q1"], e.metrics.numbers.get("plans", {}).get("")] for e in found.entries}))"""


def test_compare_runs_members_from_abroad(abroad: Path) -> None:
    """The table has them all, the plan's metrics reach through two wrappers."""
    answer = run(abroad, "-c", COMPARED)
    assert answer.returncode == 0, answer.stderr
    rows = json.loads(answer.stdout)
    assert set(rows) == {"poles", "poles+clipped", "saturated+FPI", "learner", "RHC"}
    assert rows["RHC"][1] > 0
    assert rows["poles+clipped"][0] < 0.5 * rows["poles"][0]
