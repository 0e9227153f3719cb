"""Reports in a real browser: nothing overlaps, nothing is cut without a hint, nothing is fetched, nothing is complained about."""

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.labs import exported

import fpirhc as fp

pytestmark = pytest.mark.browser

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Chromium, of the system or of Playwright."""
    api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed: ./scripts/nightly")
    with api.sync_playwright() as playwright:
        own = playwright.chromium.executable_path
        path = next(filter(None, map(shutil.which, NAMES)), own if Path(own).exists() else None)
        if path is None:
            pytest.skip("no browser is installed: neither Chromium nor Chrome is on the PATH, and Playwright has none")
        # As root Chromium starts without its sandbox only; the pages are those of this project.
        sandbox = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
        chromium = playwright.chromium.launch(executable_path=path, args=sandbox)
        yield chromium
        chromium.close()


@dataclass
class Opened:
    """A page in the browser, what it complained about, asked for, and did not get."""

    page: Any
    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)
    refusals: dict[str, str] = field(default_factory=dict)


@pytest.fixture
def visit(browser: Any) -> Iterator[Any]:
    """Function (path of a page, width, colour scheme) -> the opened page, after its first frames."""
    contexts = []

    def opened(path: Path, width: int = 1280, scheme: str = "light", motion: str = "no-preference") -> Opened:
        screen = {"width": width, "height": 800}
        contexts.append(browser.new_context(viewport=screen, color_scheme=scheme, reduced_motion=motion))
        one = Opened(contexts[-1].new_page())
        one.page.on("console", lambda m: one.complaints.append(m.text) if m.type in ("error", "warning") else None)
        one.page.on("pageerror", lambda error: one.complaints.append(str(error)))
        one.page.on("requestfailed", lambda request: one.refusals.update({request.url: request.failure}))
        one.page.on("request", lambda request: one.requests.append(request.url))
        one.page.goto(path.as_uri())
        settle(one.page)
        return one

    yield opened
    for context in contexts:
        context.close()


def settle(page: Any) -> None:
    """Wait until the page has drawn two more frames."""
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


@pytest.fixture(scope="session")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder in which pictures of the pages are kept."""
    wanted = os.environ.get("FPIRHC_PICTURES")
    folder = Path(wanted) if wanted else tmp_path_factory.mktemp("pictures")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def until(page: Any, condition: str) -> None:
    """Return once a condition holds, asked in every frame; the policy of the pages forbids `wait_for_function` to compile it."""
    look = f"const look = () => {condition} ? done() : requestAnimationFrame(look);"
    page.evaluate(f"new Promise((done, failed) => {{ setTimeout(failed, 30000, 'it never held'); {look} look(); }})")


@pytest.fixture(scope="session")
def drawn(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report with a mechanism that moves and a portrait."""
    del browser
    shipped = fp.load_problem("ball_on_plate")
    both = {name: shipped.controllers[name] for name in ("RHC", "RHC+FPI")}
    plane = fp.Portrait("Place", x="plant_state.x", y="plant_state.y")
    short = replace(shipped.problem, duration=2.0, measure_from=0.0)
    pictures = (*shipped.pictures, plane)
    task = replace(shipped, problem=short, controllers=both, tuning={}, pictures=pictures)
    path = tmp_path_factory.mktemp("drawn") / "drawn.html"
    fp.write_report(fp.compare(task, seed=0, compiled=False), path)
    return path


@pytest.mark.parametrize("motion", ["no-preference", "reduce"])
def test_a_mechanism_plays_when_it_is_asked(motion, drawn, visit, pictures):
    """It rests at first, plays and pauses by its button, follows its slider; nothing is fetched, whatever the reader prefers."""
    opened = visit(drawn, 1280, "light", motion)
    page = opened.page

    def shown() -> float:
        """Seconds on the page once ten more frames are drawn, in which a mechanism that plays moves."""
        page.evaluate("(async () => { for (let k = 0; k < 10; k++) await new Promise(requestAnimationFrame); })()")
        return float(page.inner_text(".motion output").removesuffix(" s"))

    assert shown() == 0.0
    page.click(".motion button")
    until(page, "parseFloat(document.querySelector('.motion output').textContent) > 0.1")
    page.click(".motion button")
    assert shown() == shown() > 0.1
    page.fill(".motion input[type=range]", "500")
    assert shown() == pytest.approx(1.0)
    assert opened.complaints == []
    assert all(r.startswith(("data:", drawn.as_uri())) for r in opened.requests)
    page.screenshot(path=pictures / f"mechanism-{motion}.png", full_page=True)


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_a_lab_runs_anew_while_a_slider_moves(width, scheme, visit, pictures, tmp_path, capsys):
    """Sentence and Python follow the slider; nothing is fetched or complained about, and memory does not grow."""
    pytest.importorskip("ziglang", reason="zig is not installed: pip install 'fpirhc[compiler]'")
    path, data = exported(tmp_path, "two_mass", "CTC+FPI (eq 6)")
    opened = visit(path, width, scheme)
    page = opened.page

    def moved(factor: float) -> str:
        return move(page, "exact.m1", factor)

    first, second = moved(1.0), moved(2.0)
    assert first != second
    code = page.inner_text("#python")
    assert 'fp.with_settings(task.problem, {"plant.parameters.m1.exact": 2})' in code
    exec(code, {})
    assert capsys.readouterr().out.count("10000 cycles of 0.001 s, seed 0") == 1
    compare_curves(page, data)
    assert moved(1.0) == first
    size = page.evaluate("performance.memory.usedJSHeapSize")
    for k in range(500 if scheme == "light" else 40):
        moved(1 + k / 500)
    assert page.evaluate("performance.memory.usedJSHeapSize") < 2 * size + 2e7
    page.screenshot(path=pictures / f"lab-{width}-{scheme}.png", full_page=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert not opened.complaints
    assert not [address for address in opened.requests if not address.startswith(("file:", "blob:"))]


def move(page: Any, path: str, factor: float) -> str:
    """The sentence after a slider was moved."""
    number = page.evaluate("window.shownNumber || 0")
    place = f"DATA.sliders.findIndex((s) => s.path === '{path}')"
    page.evaluate(f"set({place}, {factor} * (DATA.sliders[{place}].value || 1))")
    until(page, f"!busy && (window.shownNumber || 0) !== {number}")
    return str(page.inner_text("#sentence"))


def compare_curves(page: Any, data: Any) -> None:
    """Every point of every curve that is drawn is that of the runs of the page's Python, to 1e-12 of the largest number."""
    runs: list[fp.Run] = []
    exec(page.inner_text("#python").replace("print(", "runs.append("), {"runs": runs})
    drawn = page.evaluate("charts.map(({ spec, plot }) => [spec.column, ...plot.data.map((line) => [...line])])")
    assert len(drawn) >= 3
    for column, times, *lines in drawn:
        for loop, one, line in zip(data["loops"], runs, lines, strict=False):
            for wanted, values in ((one.time, times), (np.ravel(one[column]), line)):
                np.testing.assert_allclose(
                    values, wanted[:: loop["every"]], rtol=0, atol=1e-12 * max(1.0, np.abs(wanted).max())
                )


@pytest.mark.parametrize(
    ("name", "path", "factor"),
    [
        ("turbojet", "approximate.B_T", 0.625),  # with another first plan the error would be 20 % larger
        ("fishery", "exact.survival", 1.5),  # the biomass leaves its range, which ends the run
    ],
)
def test_the_curves_of_a_lab_are_those_of_its_python(name, path, factor, visit, tmp_path):
    pytest.importorskip("ziglang", reason="zig is not installed: pip install 'fpirhc[compiler]'")
    task = fp.load_problem(name)
    path_, data = exported(
        tmp_path, name, "RHC" if name == "two_mass" else (task.headline or list(task.controllers))[-1]
    )
    opened = visit(path_)
    until(opened.page, "window.shownNumber && !busy")
    first = str(opened.page.inner_text("#sentence"))
    assert move(opened.page, path, factor) != first
    compare_curves(opened.page, data)
    assert not opened.complaints
