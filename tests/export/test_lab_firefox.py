"""The lab in Firefox, which WebDriver BiDi drives: the numbers are those of `simulate`, and the console is silent."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.export.lab.lab import make_lab, write_lab
from fpirhc.symbolic.paths import changed_at

PROGRAM = shutil.which("firefox-esr") or shutil.which("firefox")
PLACE = "DATA.sliders.findIndex((s) => s.path === 'exact.m1')"
CURVES = "JSON.stringify(answers.map((a) => a.columns.map((c) => [...c])))"


class Firefox:
    """A page in a browser without a window; `complaints` are the console's."""

    def __init__(self, socket: Any, process: int) -> None:
        self._socket, self._count, self._process = socket, 0, process
        self.complaints: list[str] = []
        self.ask("session.new", capabilities={})
        self.ask("session.subscribe", events=["log.entryAdded"])
        self._page = self.ask("browsingContext.getTree")["contexts"][0]["context"]

    def ask(self, method: str, **values: Any) -> Any:
        """The answer to a command; what the console says meanwhile is kept."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": values}))
        while True:
            said = json.loads(self._socket.recv(timeout=60))
            if said.get("method") == "log.entryAdded" and said["params"]["level"] in ("warn", "error"):
                self.complaints.append(str(said["params"]["text"]))
            if said.get("id") == self._count:
                assert said["type"] == "success", said
                return said["result"]

    def open(self, path: Path) -> None:
        self.ask("browsingContext.navigate", context=self._page, url=path.as_uri(), wait="complete")

    def move(self, mass: float) -> None:
        """Move the slider of the first mass, and wait until the page shows the run with it."""
        began = self.evaluate("window.shownNumber || 0")
        self.evaluate(f"set({PLACE}, {mass!r})")
        done = f"!busy && (window.shownNumber || 0) !== {began}"
        look = f"const look = () => {done} ? resolve() : requestAnimationFrame(look); look();"
        self.evaluate(f"new Promise((resolve) => {{ {look} }})")

    def memory(self) -> int:
        """Bytes of memory of the browser's processes; a page that several processes share counts once."""
        said = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True).stdout
        rows = [tuple(map(int, line.split())) for line in said.splitlines()]
        own = {self._process}
        while more := {one for one, parent in rows if parent in own} - own:
            own |= more
        return 1024 * sum(map(_proportional, own))

    def evaluate(self, expression: str) -> Any:
        """The value of an expression that is text, a number or a promise of these."""
        target = {"context": self._page}
        said = self.ask("script.evaluate", expression=expression, target=target, awaitPromise=True)
        assert said["type"] == "success", said
        return said["result"].get("value")


def _proportional(process: int) -> int:
    """Kilobytes of a process, with its share of what it shares; 0 for one that has ended meanwhile."""
    try:
        said = Path(f"/proc/{process}/smaps_rollup").read_text()
    except OSError:
        return 0
    found = re.search(r"^Pss:\s+(\d+)", said, re.MULTILINE)
    return int(found[1]) if found else 0


@pytest.fixture
def firefox(tmp_path: Path) -> Iterator[Firefox]:
    if PROGRAM is None:
        pytest.skip("Firefox is not installed")
    pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
    profile = tmp_path / "profile"
    profile.mkdir()
    with opened(profile) as browser:
        yield browser


@contextmanager
def opened(profile: Path) -> Iterator[Firefox]:
    """Firefox with an empty profile, and without the processes that it starts in advance."""
    from websockets.sync import client

    assert PROGRAM is not None
    (profile / "user.js").write_text('user_pref("dom.ipc.processPrelaunch.enabled", false);\n')
    started = subprocess.Popen(
        [PROGRAM, "--headless", "--no-remote", "--profile", str(profile), "--remote-debugging-port", "0"],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert started.stderr
        found = next(m for text in started.stderr if (m := re.search(r"BiDi listening on (ws://\S+)", text)))
        with client.connect(f"{found[1]}/session", max_size=None) as socket:
            yield Firefox(socket, started.pid)
    finally:
        started.terminate()
        started.wait()
        assert started.stderr
        started.stderr.close()


@pytest.mark.browser
def test_firefox_has_the_numbers_of_a_run(firefox, tmp_path):
    """Every curve to 1e-12 of the largest number, before and after a move; 500 moves, and the console is silent."""
    pytest.importorskip("ziglang", reason="zig is not installed: pip install 'fpirhc[compiler]'")
    task = fp.load_problem("two_mass")
    chosen = {name: task.controllers[name] for name in ("CTC", "CTC+FPI (eq 6)")}
    lab = make_lab(task.name, task.title, "two_mass", task.problem, chosen, pictures=task.pictures)
    write_lab(lab, tmp_path / "lab.html")
    firefox.open(tmp_path / "lab.html")
    for mass in (1.0, 1.7):
        firefox.move(mass)
        said = json.loads(firefox.evaluate(CURVES))
        for loop, columns in zip(lab.loops, said, strict=True):
            variant = changed_at(loop.ready.problem, "plant.parameters.m1.exact", mass)
            run = loop.ready.run(seed=0, variant=variant)
            for name, values in zip(loop.shown, columns, strict=True):
                wanted = np.ravel(run[name])[:: loop.every]
                assert np.abs(np.array(values) - wanted).max() <= 1e-12 * max(1.0, np.abs(wanted).max()), name
    first, last = (_least_memory(firefox, moves) for moves in (100, 500))
    assert last < first + 100e6
    assert "CTC+FPI (eq 6)" in firefox.evaluate("document.getElementById('sentence').textContent")
    assert firefox.evaluate("document.getElementById('motion').querySelectorAll('canvas').length") == 2
    assert firefox.complaints == []


def _least_memory(firefox: Firefox, moves: int) -> int:
    """The least memory during many moves: a garbage collection that has not come yet is no leak."""
    seen = []
    for k in range(1, moves + 1):
        firefox.move(0.5 + k / 250)
        if k % 10 == 0:
            seen.append(firefox.memory())
    return min(seen[len(seen) // 2 :])
