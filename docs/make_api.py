"""Writes the API page from the public names and the members that are found: python docs/make_api.py"""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

import fpirhc as fp
from fpirhc.members import FAMILIES, member_classes

PAGE = Path(__file__).resolve().parent / "api.rst"
STUB = Path(fp.__file__).with_suffix(".pyi")
SECTIONS = {
    "Plants and problems": ("plant", "task", "problem_files", "symbolic"),
    "Sensing": ("sensing",),
    "Controllers": ("controllers", "export"),
    "Tracking laws": ("tracking",),
    "Deformations": ("deformation", "contraction"),
    "Horizons and optimisers": ("horizon", "optimisers"),
    "Learning": ("learning",),
    "Running and measuring": ("simulation", "status"),
    "Review, studies and reports": ("review", "probing", "studies", "report", "baselines"),
    "Testing and errors": ("conformance", "errors"),
}
BESIDE = {  # for authors of members and for tools; imported from the module
    "Axis": "fpirhc.studies.sweep",
    "Certificate": "fpirhc.studies.open_loop",
    "Combination": "fpirhc.plant.regressor",
    "Comparison": "fpirhc.studies.comparison.comparison",
    "Floquet": "fpirhc.controllers.slots.slotted",
    "LyapunovView": "fpirhc.simulation.lyapunov_view",
    "ManyRuns": "fpirhc.simulation.lanes",
    "Metrics": "fpirhc.simulation.metrics",
    "OutputChain": "fpirhc.controllers.slots.slot",
    "Prediction": "fpirhc.review.response_prediction",
    "Probe": "fpirhc.probing.probe",
    "Regressor": "fpirhc.plant.regressor",
    "Review": "fpirhc.review.question",
    "RobustBoxes": "fpirhc.studies.robust",
    "ScenarioComparison": "fpirhc.studies.scenarios.scenario_comparison",
    "Simulator": "fpirhc.simulation.simulate",
    "Suggestion": "fpirhc.review.questions.noise",
    "Sweep": "fpirhc.studies.sweep",
    "Tuning": "fpirhc.studies.tune",
    "assess_gain": "fpirhc.contraction.spectrum",
    "check_controller": "fpirhc.conformance",
    "check_deformation": "fpirhc.conformance",
    "check_gain": "fpirhc.contraction.spectrum",
    "check_live": "fpirhc.conformance",
    "check_observer": "fpirhc.conformance",
    "check_optimiser": "fpirhc.conformance",
    "check_plant": "fpirhc.conformance",
    "check_tracking": "fpirhc.conformance",
    "delayed_limit": "fpirhc.contraction.delayed",
    "disturbed": "fpirhc.plant.disturbed",
    "floquet_radius": "fpirhc.controllers.slots.slotted",
    "leaky_margin": "fpirhc.deformation.leaky",
    "leaky_pole": "fpirhc.deformation.leaky",
    "linear_parameters": "fpirhc.plant.regressor",
    "output_chain": "fpirhc.controllers.slots.slot",
    "response_jacobian": "fpirhc.contraction.spectrum",
    "robust_boxes": "fpirhc.studies.robust",
    "spectrum_over_box": "fpirhc.contraction.spectrum",
    "spectrum_over_run": "fpirhc.contraction.spectrum",
    "structural_order": "fpirhc.plant.plant",
    "sweep": "fpirhc.studies.sweep",
}
WITH_MEMBERS = {
    "Run",
    "Simulator",
    "Stepper",
    "Comparison",
    "Plan",
    "Certificate",
    "Metrics",
    "Plant",
    "Problem",
    "LyapunovView",
    "Review",
    "figures",
    "RobustBoxes",
    "Sweep",
    "Tuning",
}
INHERITED = {"Stepper": ["   :inherited-members:"]}  # its numbers in force


def by_section() -> dict[str, list[str]]:
    """Public names by section; a module that no section names is an error, so that no name is left out silently."""
    sections: dict[str, list[str]] = {title: [] for title in SECTIONS}
    homes = {module: title for title, modules in SECTIONS.items() for module in modules}
    text = re.sub(r"\(\s*([^)]*?),?\s*\)", lambda m: " ".join(m.group(1).split()), STUB.read_text(encoding="utf-8"))
    for module, names in re.findall(r"^from \.(\w+)[\w.]* import (.+)$", text, re.MULTILINE):
        sections[homes[module]] += [name.strip() for name in names.split(",") if name.strip()]
    for family, kind in FAMILIES.items():
        section = sections[homes[kind.packages[0].split(".")[1]]]
        section += [c.__name__ for c in member_classes(family) if c.__name__ not in section]
    return sections


def page() -> str:
    """The page's text."""
    about = "Names are imported from ``fpirhc``, unless said otherwise; the docstrings give equations, shapes, units and sources."
    lines = ["API", "===", "", about, ""]
    for title, names in by_section().items():
        lines += [title, "-" * len(title), ""]
        for name in names:
            lines += [*_entry(name, getattr(fp, name)), ""]
    lines += ["Beside the top level", "--------------------", "", "These are imported from their modules.", ""]
    for name, module in BESIDE.items():
        kind = "autoclass" if name[0].isupper() else "autofunction"
        lines += [f".. {kind}:: {module}.{name}"] + (["   :members:"] if name in WITH_MEMBERS else []) + [""]
    return "\n".join(lines)


def _entry(name: str, member: object) -> list[str]:
    """What the page has of a public name: a class, a function, or a module with all of its own."""
    if isinstance(member, ModuleType):
        return [f".. automodule:: {member.__name__}", *(["   :members:"] if name in WITH_MEMBERS else [])]
    kind = "autoclass" if isinstance(member, type) else "autofunction"
    return [f".. {kind}:: fpirhc.{name}", *(["   :members:"] if name in WITH_MEMBERS else []), *INHERITED.get(name, [])]


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
