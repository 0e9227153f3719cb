"""The documentation's code runs as printed, its links lead somewhere, and its lists, pages and commands are those of the code."""

from __future__ import annotations

import json
import re
import shlex
import sys
from pathlib import Path

import pytest

import fpirhc as fp
from fpirhc.controllers.contract import resolved
from fpirhc.controllers.sensing_chain import compose_with_sensing
from fpirhc.members import FAMILIES, member_classes
from fpirhc.review.questions import QUESTIONS
from fpirhc.simulation.loop import close_loop

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.insert(0, str(DOCS))
import all_problems  # noqa: E402
import made_pages  # noqa: E402

MADE = {"command_line.md"}  # when the site is built
PAGES = [page for page in sorted(DOCS.glob("*.md")) if page.name not in MADE]
TEXTS = [*PAGES, DOCS.parent / "README.md", DOCS.parent / "CONTRIBUTING.md"]
LONG = ("extending", "review", "study")  # each as long as several others together


def blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


CODE = [pytest.param(p, marks=[pytest.mark.slow] * (p.stem in LONG), id=p.stem) for p in TEXTS if blocks(p)]


@pytest.mark.parametrize("page", CODE)
def test_code_runs(page, tmp_path, monkeypatch):
    """The blocks of a page, one after the other, as a reader would paste them."""
    monkeypatch.chdir(tmp_path)
    exec(compile("\n".join(blocks(page)), str(page), "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("page", TEXTS, ids=lambda p: p.stem)
def test_commands_are_those_of_the_command_line(page):
    """Every `fpirhc` line of a page has a command and options that are there, and all that the command needs."""
    commands = made_pages.commands()
    for line in re.findall(r"^ {4}(?:\.venv/bin/)?fpirhc (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE):
        name, *words = shlex.split(line, comments=True)
        commands[name].make_context(name, words)  # raises for what is wrong


def test_a_command_that_is_not_there_is_found():
    """The check above sees a wrong option and a missing argument."""
    commands = made_pages.commands()
    for words in (["two_mass", "--scenarios", "50"], []):
        with pytest.raises(Exception, match=r"No such option|Missing parameter"):
            commands["compare"].make_context("compare", words)


@pytest.mark.parametrize("page", ["README.md", "docs/tutorial.md", "fpirhc/scaffold/problem.txt"])
def test_first_gain_is_the_one_that_review_recommends(page, tmp_path):
    """Where a user begins, nobody has guessed, and nothing is wrong."""
    text = (DOCS.parent / page).read_text(encoding="utf-8")
    if page.endswith(".md"):
        text = "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)).partition("run = fp.simulate")[0]
    (tmp_path / "first.py").write_text(text)
    task = fp.load_problem(str(tmp_path / "first.py"))
    review = fp.review(task.problem, {"it": task.controllers["RHC+FPI"]}, mismatch=0.0, seed=0)
    [gain] = [a for a in review.answers["it"] if a.key == "gain"]
    assert gain.numbers["recommended_times"] == 1
    assert review.ready


@pytest.mark.parametrize("page", [*PAGES, *sorted(DOCS.parent.glob("*.md"))], ids=lambda p: p.stem)
def test_links_lead_somewhere(page):
    """Relative links point to files and to headings in them; those into the gallery to the scripts that it is made of."""
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
        path, _, place = target.partition("#")
        if "://" in target or path in MADE:
            continue
        file = page.parent / path if path else page
        made = DOCS / "gallery_src" / f"{Path(path).name}.py"
        assert file.exists() or ("gallery/" in target and made.exists()), target
        if place:
            heads = re.findall(r"^#+ (.+)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            assert place in {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}, target


def test_every_public_name_is_on_the_api_page_once():
    page = made_pages.api()
    shown = re.findall(r"^\.\. auto(?:class|function):: fpirhc\.(\w+)$", page, re.MULTILINE)
    shown += [n for n in re.findall(r"^\.\. automodule:: fpirhc\.[\w.]*?(\w+)$", page, re.MULTILINE) if n in fp.__all__]
    members = {c.__name__ for family in FAMILIES for c in member_classes(family)}
    assert len(shown) == len(set(shown))
    assert set(shown) == set(fp.__all__) | members


def test_every_command_is_on_its_page():
    page = made_pages.command_line()
    assert re.findall(r"^## fpirhc (\w+)$", page, re.MULTILINE) == list(made_pages.commands())
    assert "--mismatch" in page


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
    files = [*(file for _, file in rows), *re.findall(r"`(fpirhc/[\w/]*\.py)`", text)]
    assert [file for file in files if not (DOCS.parent / file).is_file()] == []


def test_every_question_of_a_review_is_in_the_table_and_nothing_else():
    """A table that misses one leaves its *no* without a cure."""
    page = (DOCS / "review.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| ([A-Z][^|]+\?) \|", page, re.MULTILINE) == [question.text for question in QUESTIONS]


def test_all_problems_have_a_winner_and_a_reason():
    """Offset-free control wins where it does, the iteration where it does, nobody who is not safe."""
    table = all_problems.table()
    winners = dict(re.findall(r"^\| (\w+) \|.*\| ([^|]+) \|$", table, re.MULTILINE))
    assert (winners["hodgkin_huxley"], winners["order_four"], winners["leaking_tanks"]) == ("rival", "FPI", "rival")
    assert (winners["three_link_arm"], winners["turbojet_slow"], winners["freeway"]) == ("rival", "FPI", "draw")
    assert (winners["diabetes_order_five"], winners["diabetes"]) == ("none keeps the rule", "nobody")
    reasons = dict(re.findall(r"^- \*(\w+)\*: (.*)$", table, re.MULTILINE))
    assert set(reasons) == {path.stem for path in all_problems.files()}
    assert [name for name, why in reasons.items() if not re.fullmatch(r"[A-Z]([^.]|\.\d){60,160}\.", why)] == []


@pytest.mark.slow
def test_a_rival_that_was_tried_is_that_of_its_command():
    """One cheap problem tried again: the same controller and the same error."""
    name, error = json.loads(all_problems.TRIED.read_text(encoding="utf-8"))["freeway_metering"]
    found = all_problems.best_rival(all_problems.PROBLEMS / "gallery" / "freeway_metering.py")
    assert found is not None
    assert found[0] == name
    assert found[1] == pytest.approx(error, rel=1e-3)


def test_the_readme_says_at_once_what_the_method_asks_for():
    """Before anything can be tried: the response is measured or estimated in every cycle, and its noise reaches the command."""
    begin = " ".join((DOCS.parent / "README.md").read_text(encoding="utf-8").partition("## ")[0].split())
    assert "must be measured or estimated in every cycle, and its noise reaches the command" in begin
