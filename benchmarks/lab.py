"""How often a lab of two_mass is drawn anew while a slider moves: one loop of 10 000 cycles, three charts, in the browsers here.

    .venv/bin/python benchmarks/lab.py

Every update is timed from the slider's move to the frame that shows the charts; updates per second are those of the time below
which 95 % of the updates stay. Goals: 30 with CTC+FPI, 12 with RHC+FPI.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

import fpirhc as fp
from fpirhc.export.lab.lab import lab_of, write_lab

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "export"))
GOALS = {"CTC+FPI (eq 6)": 30, "RHC+FPI": 12}
MOVES = 100
# The charts beyond three are taken out; a move is awaited until its picture has been painted.
ONLY_THREE = "charts.splice(3).forEach(({ box }) => box.remove())"
MOVE = """(k) => new Promise((done) => {
  const began = performance.now(), place = DATA.sliders.findIndex((s) => s.path === "exact.m1"), asked = sent + 1;
  set(place, DATA.sliders[place].value * (1 + k / 200));
  const shown = () => window.shownNumber >= asked && !busy, end = () => done(performance.now() - began);
  const look = () => (shown() ? requestAnimationFrame(end) : setTimeout(look, 0));
  look();
})"""


def chromium(path: Path) -> list[float]:
    """Milliseconds of every update in Chromium."""
    from playwright.sync_api import sync_playwright  # of the extra browser, which only this function needs

    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with sync_playwright() as playwright:
        page = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"]).new_page()
        page.goto(path.as_uri())
        while page.evaluate("!window.shownNumber || busy"):
            page.wait_for_timeout(50)
        page.evaluate(ONLY_THREE)
        return [float(page.evaluate(MOVE, k)) for k in range(MOVES)]


def firefox(path: Path) -> list[float]:
    """Milliseconds of every update in Firefox."""
    from test_lab_firefox import opened

    with tempfile.TemporaryDirectory() as profile, opened(Path(profile)) as browser:
        browser.open(path)
        while browser.evaluate("!window.shownNumber || busy"):
            pass
        browser.evaluate(ONLY_THREE)
        return [float(browser.evaluate(f"({MOVE})({k})")) for k in range(MOVES)]


def main() -> None:
    """Measure and print."""
    browsers: dict[str, Callable[[Path], list[float]]] = {"Chromium": chromium}
    if shutil.which("firefox-esr") or shutil.which("firefox"):
        browsers["Firefox"] = firefox
    task = fp.load_problem("two_mass")
    with tempfile.TemporaryDirectory() as folder:
        for title, goal in GOALS.items():
            path = Path(folder) / "lab.html"
            write_lab(lab_of(task, "two_mass", [title]), path)
            for name, measure in browsers.items():
                times = measure(path)
                middle, most = np.percentile(times, [50, 95])
                print(
                    f"{title} in {name}: {1e3 / most:.1f} updates per second (goal {goal}); from move to picture {middle:.0f} ms, "
                    f"95 % below {most:.0f} ms"
                )


if __name__ == "__main__":
    main()
