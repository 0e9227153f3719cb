"""The documentation's code runs as printed, its links lead somewhere, and its lists and pages are those of the code."""

from __future__ import annotations

import json
import re
import runpy
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest

import fpirhc as fp
from fpirhc.controllers.contract import resolved
from fpirhc.controllers.sensing_chain import compose_with_sensing
from fpirhc.members import FAMILIES, member_classes
from fpirhc.simulation.loop import close_loop

DOCS = Path(__file__).resolve().parents[2] / "docs"
PACKAGE = Path(fp.__file__).parent
NEEDED = {  # page -> packages of an extra
    "simulators": ("tclab", "gymnasium"),
    "outside-car": ("vehiclemodels",),
    "outside-lab": ("tclab",),
    "outside-arm": ("mujoco",),
    "outside-quadrotor": ("rotorpy",),
}
LONG = ("beside-acados", "beside-do-mpc", "probe", "optimiser")  # each as long as all others together
PAGES = sorted(p for p in DOCS.rglob("*.md") if "_build" not in p.parts)


def script(name: str) -> SimpleNamespace:
    """The names of a script of the documentation."""
    return SimpleNamespace(**runpy.run_path(str(DOCS / f"{name}.py")))


def blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


CODE = [
    pytest.param(
        p, marks=[pytest.mark.outside] * p.stem.startswith("outside") + [pytest.mark.slow] * (p.stem in LONG), id=p.stem
    )
    for p in PAGES
    if blocks(p)
]


@pytest.mark.parametrize("page", CODE)
def test_code_runs(page, tmp_path, monkeypatch):
    """The blocks of a page, one after the other, as a reader would paste them."""
    for package in NEEDED.get(page.stem, ()):
        pytest.importorskip(package, reason="it needs the extra fpirhc[outside]")
    monkeypatch.chdir(tmp_path)
    exec(compile("\n".join(blocks(page)), str(page), "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("page", ["README.md", "docs/tutorial.md", "fpirhc/scaffold/problem.txt"])
def test_first_gain_is_the_one_that_review_recommends(page, tmp_path):
    """Within 5 %: where a user begins, nobody has guessed, and nothing is wrong."""
    text = (DOCS.parent / page).read_text(encoding="utf-8")
    if page.endswith(".md"):
        text = "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)).partition("run = fp.simulate")[0]
    (tmp_path / "first.py").write_text(text)
    task = fp.load_problem(str(tmp_path / "first.py"))
    answers = fp.review(task.problem, {"it": task.controllers["RHC+FPI"]}, mismatch=0.0, seed=0).controllers["it"]
    [gain] = [a for a in answers if "gain admissible" in a.question]
    assert gain.numbers["gain"] == pytest.approx(gain.numbers["recommended"], rel=0.05)
    assert [a.question for a in answers if a.verdict == "no"] == []


@pytest.mark.parametrize("page", [*PAGES, *sorted(DOCS.parent.glob("*.md"))], ids=lambda p: p.stem)
def test_links_lead_somewhere(page):
    """Relative links point to files; those into the gallery to the scripts that it is made of."""
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        made = DOCS / "gallery_src" / f"{Path(target).name}.py"
        assert (page.parent / target).exists() or ("gallery/" in target and made.exists()), target


def test_every_public_name_is_on_the_api_page():
    """The page is made when the site is built; it holds every public name once, and every member of a family."""
    maker = script("make_api")
    page = maker.page()
    shown = re.findall(r"^\.\. auto(?:class|function):: fpirhc\.(\w+)$", page, re.MULTILINE)
    shown += re.findall(r"^\.\. automodule:: fpirhc\.[\w.]*?(\w+)$", page, re.MULTILINE)  # with all of their own
    members = {c.__name__ for family in FAMILIES for c in member_classes(family)}
    assert len(shown) == len(set(shown))
    assert set(shown) == set(fp.__all__) | members


def test_a_page_that_loads_from_elsewhere_is_found(tmp_path, capsys):
    """Scripts, pictures, styles and what a style fetches; links to other sites load nothing."""
    check = script("check_offline")
    here = (
        "<a href='https://x.org'>x</a><link rel='canonical' href='https://x.org'><script src='_static/a.js'></script>"
    )
    assert check.elsewhere(here + "<img src='data:image/png;base64,AA'>") == []
    there = "<script src='https://x.org/a.js'></script><img src='//x.org/b.png'><link rel='stylesheet' href='http://x.org/c'>"
    assert check.elsewhere(there) == ["https://x.org/a.js", "//x.org/b.png", "http://x.org/c"]
    (tmp_path / "index.html").write_text(here)
    (tmp_path / "own.css").write_text("@font-face { src: url(fonts/a.woff2) }")
    assert check.main(tmp_path) == 0
    (tmp_path / "other.css").write_text("@import 'https://x.org/a.css'; a { background: url(\"//x.org/b.png\") }")
    assert check.main(tmp_path) == 1
    assert "other.css loads https://x.org/a.css" in capsys.readouterr().err


def test_the_site_has_its_formulas_inside():
    """Every font that the style sheet names stands beside it, and nothing is named that is elsewhere."""
    folder = DOCS / "_static" / "katex"
    style = (folder / "katex.min.css").read_text(encoding="utf-8")
    named = set(re.findall(r"url\(([^)]+)\)", style))
    assert named == {f"fonts/{path.name}" for path in (folder / "fonts").iterdir()}
    assert (folder / "LICENSE").read_text(encoding="utf-8").startswith("The MIT License")


def test_the_page_on_architecture_names_the_blocks_of_a_cycle_in_their_order_and_files_that_are_there():
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`[^|]*) \| [^|]* \| `(fpirhc/[^|]*)` \|$", text, re.MULTILINE)
    told = [name for cell, _ in rows for name in re.findall(r"`(\w+)`", cell)]
    task = fp.load_problem("noisy_motor")
    ready = resolved(task.problem, task.controllers["RHC+FPI"])
    loop = [block.name for block in close_loop(task.problem, ready).blocks]
    inside = [block.name for block in compose_with_sensing(task.problem, ready).blocks]
    cycle = [name for block in loop for name in ([block, *inside] if block == "gate" else [block])]
    assert told == [name for name in cycle if name in told]
    assert {"sense", "plan_every_2", "deform", "advance"} <= set(told)
    files = [*(file for _, file in rows), *re.findall(r"\((?:`(fpirhc/[^`]*)`)\)", text)]
    assert [file for file in files if not (DOCS.parent / file).is_file()] == []


def test_every_question_of_a_review_is_in_the_table_and_nothing_else():
    """All texts of questions in the package; a table that misses one leaves its *no* without a cure."""
    texts = [file.read_text(encoding="utf-8") for file in (DOCS.parent / "fpirhc" / "review").rglob("*.py")]
    asked = {question for text in texts for question in re.findall(r'"([A-Z][^"\n]+\?)"', text)}
    table, page = ((DOCS / f"review-{name}.md").read_text(encoding="utf-8") for name in ("points", "deformation"))
    assert asked == set(re.findall(r"^\| ([A-Z][^|]+\?) \|", table, re.MULTILINE))
    explained = {*re.findall(r"^## (.+\?)$", page, re.MULTILINE), *re.findall(r"\*\*([A-Z][^*]+\?)\*\*", page)}
    assert explained
    assert explained <= asked


# The README's problem runs as printed


README = (DOCS.parent / "README.md").read_text(encoding="utf-8")


def test_the_readme_says_at_once_what_the_method_asks_for():
    """Before anything can be tried: the response is measured or estimated in every cycle, and its noise reaches the command."""
    begin = " ".join(README.partition("## ")[0].split())
    assert "must be measured or estimated in every cycle, and its noise reaches the command" in begin


# Pages of theory name modules that are there


def is_there(name: str) -> bool:
    """Whether a dotted name is that of a module of the package, or of something in one."""
    if (PACKAGE / name.replace(".", "/")).with_suffix(".py").is_file():
        return True
    module, _, last = name.rpartition(".")
    file = (PACKAGE / module.replace(".", "/")).with_suffix(".py")
    return file.is_file() and hasattr(import_module(f"fpirhc.{module}"), last)


def test_modules_that_pages_of_theory_name_are_there():
    """In headings, and wherever a dotted name begins with a package: small modules become part of their neighbours at times."""
    packages = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    texts = {page.stem: page.read_text(encoding="utf-8") for page in DOCS.glob("theory-*.md")}
    named = [(page, n) for page, text in texts.items() for n in re.findall(r"`(?:fpirhc\.)?([a-z_]+(?:\.\w+)+)`", text)]
    named = [(page, n) for page, n in named if n.split(".")[0] in packages and not n.endswith((".c", ".js", ".py"))]
    assert len(named) > 80
    assert [one for one in named if not is_there(one[1])] == []


# The page of all problems is the one that its command writes from baselines and tables


def test_page_of_all_problems_is_that_of_baselines_and_tables():
    """Written anew it is the same; offset-free control wins where it does, the iteration where it does, nobody who is not safe."""
    maker = script("make_all_problems")
    page = maker.page()
    assert page == (DOCS / "all-problems.md").read_text(encoding="utf-8")
    rows, reasons = (
        {
            line.split(" | ")[0].strip("| "): line.strip(" |").split(" | ")
            for line in part.splitlines()
            if line.startswith("| ")
        }
        for part in page.split("## Why")
    )
    assert (rows["hodgkin_huxley"][6], rows["order_four"][6], rows["tumour"][6]) == ("rival", "FPI", "rival")
    assert (rows["three_link_arm"][6], rows["turbojet_slow"][6], rows["freeway"][6]) == ("rival", "FPI", "draw")
    assert (rows["diabetes_order_five"][6], rows["diabetes"][6]) == ("none keeps the rule", "nobody")
    named = {path.stem: reasons[path.stem][1] for path in maker.files()}
    assert [name for name, why in named.items() if not re.fullmatch(r"[A-Z]([^.]|\.\d){60,160}\.", why)] == []


def test_runs_that_pages_of_the_gallery_keep_are_those_of_the_baselines():
    """`--renew` writes them anew; the figure that the problem is judged by is that of `check`, by name of the file."""
    for file in (DOCS / "gallery_src" / "kept").glob("*, *.npz"):
        name, controller = file.stem.split(", ")
        task, run = fp.load_problem(name), fp.load_run(file)
        assert task.headline_metric is not None
        stored = json.loads((task.path.parent / "baselines" / f"{name}.json").read_text(encoding="utf-8"))
        value = stored["controllers"][controller]["metrics"][task.headline_metric]["value"]
        assert fp.measure(task.problem, run, task.metrics)[task.headline_metric][""] == pytest.approx(value, rel=1e-4)


@pytest.mark.slow
def test_a_row_of_realities_that_is_kept_is_that_of_its_page(monkeypatch):
    """The errors of all controllers with the model's own reality, computed anew."""
    monkeypatch.setattr("sys.argv", ["plot_realities.py"])
    monkeypatch.chdir(DOCS / "gallery_src")
    page = runpy.run_path(str(DOCS / "gallery_src" / "plot_realities.py"))
    assert page["row"](None) == pytest.approx(page["kept"]["errors"]["model's own"], rel=1e-3)


@pytest.mark.slow
def test_a_rival_that_was_tried_is_that_of_its_command(monkeypatch):
    """One cheap problem tried again: the same controller and the same error, which stand on the page."""
    monkeypatch.syspath_prepend(str(DOCS))
    maker, page = script("make_rivals"), script("make_all_problems")
    found = maker.best(fp.load_problem("freeway_metering"), "density", filters=True)
    stored = json.loads(page.TRIED.read_text(encoding="utf-8"))["freeway_metering"]
    assert found["rival"] == stored["rival"]
    assert found["error"] == pytest.approx(stored["error"], rel=1e-3)
    assert f"{stored['error']:.2g} ({stored['rival']})" in page.page()
