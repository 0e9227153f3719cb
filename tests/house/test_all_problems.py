"""The page of all problems is the one that its command writes from the baselines."""

from __future__ import annotations

import importlib.util
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def test_page_of_all_problems_is_that_of_the_baselines():
    """Written anew it is the same; offset-free control wins where it does, and the iteration where it does."""
    spec = importlib.util.spec_from_file_location("make_all_problems", DOCS / "make_all_problems.py")
    assert spec is not None
    assert spec.loader is not None
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    page = maker.page()
    assert page == (DOCS / "all-problems.md").read_text(encoding="utf-8")
    rows = {line.split(" | ")[0].strip("| "): line.split(" | ") for line in page.splitlines() if line.startswith("| ")}
    assert (rows["hodgkin_huxley"][6], rows["order_four"][6], rows["tumour"][6]) == ("rival", "FPI", "draw")
