"""Baselines: what bands are made of, what a baseline file may be, what outputs do with hostile names, and the pytest plugin."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
import pytest
from blessed import LINE, NOISY, write_problems

import fpirhc as fp
from fpirhc.baselines.baseline import (
    BANDED,
    EXACT,
    FACTOR,
    KINDS,
    TIGHT,
    Expected,
    differences,
    expected,
    fingerprint,
    problems_here,
    settings_of,
    to_text,
)
from fpirhc.baselines.check import read_baseline
from fpirhc.baselines.judging import Judgement, Row, judge
from fpirhc.baselines.measuring import (
    DIVERGED,
    FINISHED,
    INTEGRATOR,
    NOMINAL,
    ROUNDING,
    SEEDS,
    Measurement,
    Variant,
    metric_of,
    variants,
)
from fpirhc.baselines.printing import to_markdown
from fpirhc.cli.main import main
from fpirhc.cli.verb import ExitCode
from fpirhc.errors import BaselineError, InvalidName
from fpirhc.simulation.metrics import known_metrics

pytest_plugins = ["pytester"]

VARIANTS = [Variant(source, source, 0, False) for source in (NOMINAL, SEEDS, ROUNDING, INTEGRATOR)]


def measured(*values, name="rms_error.y", outcome=FINISHED):
    """One result per variant."""
    return [Measurement(outcome, "", {name: value}) for value in values]


@pytest.fixture(scope="module")
def blessed(tmp_path_factory):
    """A folder with two problems and their baselines."""
    folder = tmp_path_factory.mktemp("blessed")
    write_problems(folder)
    return folder


@pytest.fixture
def folder(blessed, tmp_path, monkeypatch) -> Path:
    """A copy that a test may spoil."""
    shutil.copytree(blessed, tmp_path / "project")
    monkeypatch.chdir(tmp_path / "project")
    return tmp_path / "project"


def test_a_band_is_three_times_the_spread():
    """Of all sources the widest counts, and each is kept beside the band."""
    band_value = expected(VARIANTS, measured(1.0, 1.1, 0.99, 1.0), 1e-3).metrics["rms_error.y"]
    assert band_value.kind == BANDED
    assert band_value.band == pytest.approx(0.3, rel=0.01)
    assert band_value.band >= 3 * 0.1
    assert band_value.spread == pytest.approx({SEEDS: 0.1, ROUNDING: 0.01})


def test_another_draw_of_the_noise_stays_in_the_band():
    """Of a normal value and eight seeds, within a factor of two of the 1.2e-4 that a simulation gives."""
    draws = np.random.default_rng(0).normal(size=(400_000, 9))
    outside = np.abs(draws[:, 8] - draws[:, 0]) > FACTOR * np.ptp(draws[:, :8], axis=1)
    assert outside.mean() == pytest.approx(1.2e-4, rel=1.0)
    selection = [VARIANTS[0], *[VARIANTS[1]] * 7]
    for row in draws[:20]:
        band_value = expected(selection, measured(*row[:8]), 1e-3).metrics["rms_error.y"]
        assert band_value.band == pytest.approx(FACTOR * np.ptp(row[:8]), rel=0.011)
        assert band_value.band >= FACTOR * np.ptp(row[:8])


def test_a_band_is_never_narrower_than_rounding():
    """Without any spread 1e-6 of the value is left, and something where the value is zero."""
    for value in (3.0, -2e-5, 0.0):
        band = expected(VARIANTS, measured(*[value] * 4), 1e-3).metrics["rms_error.y"].band
        assert 1e-6 * abs(value) <= band <= 1.02e-6 * abs(value) + 2e-12
        assert band > 0


@pytest.mark.parametrize(("name", "kind"), [("status.OK", EXACT), ("plan.cost", TIGHT), ("effort.u", BANDED)])
def test_three_classes(name, kind):
    """Where the variants agree, the class is the family's; where they do not, it is a band."""
    assert expected(VARIANTS, measured(5, 5, 5, 5, name=name), 1e-3).metrics[name].kind == kind
    spread = expected(VARIANTS, measured(5, 6, 5, 5, name=name), 1e-3).metrics[name]
    assert spread.kind == BANDED
    assert spread.band == pytest.approx(3, rel=0.01)


def test_what_only_some_variants_have_is_not_compared():
    """It is named with the reason; what none has is expected to be missing."""
    some = expected(VARIANTS, measured(1.0, np.nan, 1.0, 1.0, name="settling.y"), 1e-3)
    assert not some.metrics
    assert "some have none" in some.not_compared["settling.y"]
    none = expected(VARIANTS, measured(*[np.nan] * 4, name="settling.y"), 1e-3)
    assert none.metrics["settling.y"].value is None
    words = expected(VARIANTS, measured("OK", "OK", "INFEASIBLE", "OK", name="plan.status"), 1e-3)
    assert "plan.status" in words.not_compared


def test_a_run_that_may_diverge_compares_only_how_it_ends(blessed):
    """Whatever its numbers; another class of outcome is a change."""
    results = [*measured(1.0, 1.0, 1.0), Measurement(DIVERGED, "at 3 s", {})]
    band = expected(VARIANTS, results, 1e-3)
    assert band == Expected((FINISHED, DIVERGED), {}, {})
    task = fp.load_problem(str(blessed / "noisy.py"))
    whole = replace(read_baseline(blessed / "baselines" / "noisy.json"), controllers={"CTC": band})
    for outcome, holds in ((FINISHED, True), (DIVERGED, True), ("refused (NotSupported)", False)):
        fresh = {"CTC": Measurement(outcome, "", {"rms_error.y": 1e9})}
        assert judge(whole, settings_of(task), fresh).holds == holds


@pytest.mark.parametrize("name", ["effort.u", "effort"])
def test_a_summary_speaks_of_the_problems_headline_metric(folder, name, capsys):
    """In place of the rms errors, where everything holds; one coordinate, or all of a metric's."""
    file = folder / "line.py"
    file.write_text(f"{file.read_text()}headline_metric = '{name}'\n")
    assert main(["check", "line.py", "--no-compile"]) == ExitCode.FINISHED
    shown = capsys.readouterr().out
    assert "effort.u" in shown
    assert "rms_error" not in shown


def test_seeds_are_varied_only_where_there_is_noise(blessed):
    """Without noise every seed gives the same run; with noise there are as many as asked for."""
    for name, count in (("line", 0), ("noisy", 4)):
        problem = fp.load_problem(str(blessed / f"{name}.py")).problem
        selection = variants(problem, seed=3, seeds=5, compiled=False)
        assert selection[0] == Variant(NOMINAL, "nominal", 3, False)
        assert [v.seed for v in selection if v.source == SEEDS] == [4, 5, 6, 7][:count]
        assert {v.source for v in selection} >= {ROUNDING, INTEGRATOR}


def test_every_measured_metric_is_in_the_catalogue(blessed):
    for name in ("line", "noisy"):
        for one in read_baseline(blessed / "baselines" / f"{name}.json").controllers.values():
            assert all(metric_of(metric).compared in KINDS for metric in one.metrics)
    with pytest.raises(InvalidName, match="Did you mean 'rms_error'"):
        metric_of("rms_eror.y")


def test_a_baseline_says_what_it_was_made_of(blessed):
    """Reason, date, seed, versions and variants; one metric per line; written and read it is the same."""
    path = blessed / "baselines" / "line.json"
    baseline = read_baseline(path)
    assert baseline.reason == "first"
    assert baseline.date.startswith("20")
    assert {"fpirhc", "casadi", "machine"} <= set(baseline.versions)
    assert baseline.varied[INTEGRATOR] == ["twice the integrator steps"]
    assert to_text(baseline) == path.read_text()
    assert sum('"status.OK": {"kind"' in line for line in path.read_text().splitlines()) == 3


def test_stale_settings_are_named(folder, capsys):
    """Which setting it was, before and now, in the problem and in a controller."""
    text = (folder / "line.py").read_text()
    (folder / "line.py").write_text(text.replace("gain=-0.5", "gain=-0.4").replace("stages=8", "stages=9"))
    assert main(["check", "line.py", "--no-compile"]) == 6
    printed = capsys.readouterr().out
    assert "stale: problem: horizon.stages was 8, is 9" in printed
    assert "stale: controller 'CTC+FPI': deformation.gain was -0.5, is -0.4" in printed
    assert "controller 'CTC':" not in printed
    assert "first" in printed


def test_accept_replaces_a_baseline_and_keeps_the_reason(folder, capsys):
    """After it the check holds again; the widths of the bands are told, and by every command which metric broke."""
    text = (folder / "noisy.py").read_text() + "metrics = (fp.Metric('mine', lambda problem, run: 1 / 0),)\n"
    (folder / "noisy.py").write_text(text.replace("rate=6.0", "rate=7.0"))
    assert main(["check", "noisy.py", "--no-compile"]) == 6
    given = ("--seed", "3", "--seeds", "2")
    assert main(["accept", "noisy.py", "--reason", "other seeds", "--no-compile", *given]) == 0
    assert main(["accept", "noisy.py", "--reason", " faster\n tracking", "--no-compile"]) == 0
    accepted = read_baseline(folder / "baselines" / "noisy.json")
    assert (accepted.reason, accepted.seed, accepted.varied[SEEDS]) == ("faster tracking", 3, ["seed 4"])
    assert main(["check", "noisy.py", "--no-compile"]) == 0
    assert main(["run", "noisy.py", "CTC", "--no-compile"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "± " in shown
    (folder / "noisy.py").write_text((folder / "noisy.py").read_text().replace("1 / 0", "1.0"))
    assert main(["check", "noisy.py", "--no-compile"]) == ExitCode.CHANGED, "a metric that was mended is new"
    assert shown.count("metric 'mine' could not be computed (ZeroDivisionError: division by zero)") == 5


def signed(facts):
    facts.pop("checksum", None)
    return json.dumps({**facts, "checksum": fingerprint(facts)})


def spoilt(change):
    def text(path):
        facts = json.loads(path.read_text())
        change(facts)
        return signed(facts)

    return text


def _metrics(facts):
    return facts["controllers"]["CTC"]["metrics"]


SIZE = {"kind": "exact", "value": 300}
BAD_FILES = {
    "truncated": (lambda path: path.read_text()[:700], "no complete JSON"),
    "merge conflict": (lambda path: "<<<<<<< HEAD\n" + path.read_text(), "no complete JSON"),
    "no object": (lambda path: "[1, 2]", "expected an object, got list"),
    "nested too deep": (lambda path: "[" * 100_000, "no complete JSON"),
    "doubled key": (lambda path: path.read_text().replace('"seed"', '"format": 1, "seed"', 1), "twice"),
    "newer format": (lambda path: json.dumps({"format": 2}), "written by a newer fpirhc; upgrade"),
    "another thing": (lambda path: "{}", "not a baseline of format 1"),
    "no checksum": (lambda path: path.read_text().replace('"checksum"', '"sum"'), "not a baseline of format 1"),
    "unknown metric": (spoilt(lambda f: _metrics(f).update({"rms_eror.y": SIZE})), "Did you mean 'rms_error'"),
    "unknown class": (spoilt(lambda f: _metrics(f)["cycles"].update(kind="rough")), "class 'rough'"),
    "without bands": (spoilt(lambda f: f["controllers"]["CTC"].update(metrics={"cycles": SIZE})), "no metric with a band"),
    "negative band": (spoilt(lambda f: _metrics(f)["effort.u"].update(band=-1.0)), "has no band"),
    "huge number": (spoilt(lambda f: _metrics(f)["effort.u"].update(value=10**400)), "CTC: effort.u has the value"),
    "truth value": (spoilt(lambda f: _metrics(f)["cycles"].update(value=True)), "expected a finite number"),
    "settings edited": (spoilt(lambda f: f["settings"]["problem"].update(period=1.0)), "hash of its settings"),
    "settings of others": (spoilt(lambda f: f["controllers"].update(X=f["controllers"]["CTC"])), "their settings differ"),
    "metrics a list": (spoilt(lambda f: f["controllers"]["CTC"].update(metrics=[])), "lacks or misshapes"),
    "no reason": (spoilt(lambda f: f.update(reason=" ")), "has no reason"),
    "path for a name": (spoilt(lambda f: f.update(problem="../../etc/passwd")), "is the baseline of"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_baselines_are_refused(case, folder):
    """One clear error that names the file; whatever is wrong with it."""
    make, message = BAD_FILES[case]
    path = folder / "baselines" / "noisy.json"
    text = make(path)
    path.write_text(text)
    with pytest.raises(BaselineError, match=r"noisy\.json") as caught:
        read_baseline(path, known_metrics())
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_baseline_that_is_no_text_or_no_file(folder, capsys):
    path = folder / "baselines" / "noisy.json"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BaselineError, match="is no text"):
        read_baseline(path)
    path.unlink()
    path.mkdir()
    assert main(["check", "noisy.py", "--no-compile"]) == 6
    assert "cannot be read" in capsys.readouterr().out.replace("\n", " ")


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["accept", "line.py", "--reason", "  "], 2, "needs a reason"),
        (["accept", "line.py", "--reason", "x", "--baselines", "../elsewhere"], 3, "outside of the project"),
        (["accept", "two_mass", "--reason", "x"], 3, "outside of the project"),
        (["check", "--markdown", "line.py"], 3, "is not overwritten"),
        (["check", "--markdown", "baselines/line.json"], 3, "is not overwritten"),
        (["check", "--markdown", "a" * 300], 3, "File name too long"),
        (["check", "--baselines", "nowhere", "noisy.py", "--no-compile"], 6, "there is no baseline 'noisy.json'"),
    ],
)
def test_bad_arguments_change_nothing(arguments, code, message, folder, capsys):
    """One clear error, the exit code of its kind, and every file as it was."""
    before = {path: path.read_bytes() for path in folder.parent.rglob("*") if path.is_file()}
    assert main(arguments) == code
    printed = capsys.readouterr()
    assert message in (printed.out + printed.err).replace("\n", " ")
    assert {path: path.read_bytes() for path in folder.parent.rglob("*") if path.is_file()} == before


def test_links_out_of_the_project_are_not_followed(folder, capsys):
    """A baseline folder that is a link to somewhere else is not written to."""
    outside = folder.parent / "outside"
    (folder / "baselines").rename(outside)
    (folder / "baselines").symlink_to(outside, target_is_directory=True)
    before = (outside / "noisy.json").read_bytes()
    assert main(["accept", "noisy.py", "--reason", "x", "--no-compile"]) == 3
    assert "outside of the project" in capsys.readouterr().err
    assert (outside / "noisy.json").read_bytes() == before


@pytest.mark.parametrize(
    ("text", "message"),
    [("noisy = ''", "needs a reason"), ("noisy = [", "cannot be read"), ("ghost = 'x'", "names 'ghost'")],
)
def test_unchecked_problems_need_a_reason(text, message, folder, capsys):
    """The list of exceptions cannot grow stale or silent."""
    (folder / "baselines" / "noisy.json").unlink()
    (folder / "baselines" / "unchecked.toml").write_text(text)
    assert main(["check", "--no-compile"]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "counts"),
    [
        ("problem, controllers = 1, {}", True),
        ("from line import problem, controllers", True),
        ("problem: int = 1\nif True:\n    controllers = {}", True),
        ("problem = = 1", True),
        ("def f():\n    problem, controllers = 1, {}", False),
        ("problem = 1", False),
    ],
)
def test_what_counts_as_a_problem_file(text, counts, folder):
    """Whatever defines both names, however it does; one with a mistake in it must not be passed over."""
    (folder / "other.py").write_text(text)
    files, unchecked = problems_here(folder)
    assert [path.name for path in files] == ["line.py", "noisy.py", "other.py"][: 2 + counts]
    assert unchecked == {}


def test_folders_of_a_problems_folder_are_checked_too(tmp_path):
    """Each with its own baselines and its own reasons for having none; folders without problems are passed over."""
    inner = tmp_path / "problems" / "gallery"
    (inner / "baselines").mkdir(parents=True)
    (tmp_path / "problems" / "notes").mkdir()
    for path in (tmp_path / "problems" / "one.py", inner / "two.py", inner / "three.py"):
        path.write_text("problem, controllers = 1, {}")
    (inner / "baselines" / "gone.json").write_text("{}")
    (inner / "baselines" / "unchecked.toml").write_text('three = "slow"')
    files, unchecked = problems_here(tmp_path)
    assert [str(p.relative_to(tmp_path / "problems")) for p in files] == ["gallery/gone.py", "one.py", "gallery/two.py"]
    assert unchecked == {"three": "slow"}


def test_two_problems_of_one_name_are_refused(tmp_path):
    """One of them would go unchecked."""
    for inner in ("a", "b"):
        (tmp_path / "problems" / inner).mkdir(parents=True)
        (tmp_path / "problems" / inner / "arm.py").write_text("problem, controllers = 1, {}")
    with pytest.raises(BaselineError, match=r"a/arm.py' and '.*b/arm.py' have one name; rename one"):
        problems_here(tmp_path)


def test_a_number_is_the_same_with_and_without_a_point():
    """An edit from 2.0 to 2 changes no run, and from True to 1 is another kind of setting."""
    assert differences("problem", {"duration": 2.0, "box": [-1.0, 1.0]}, {"duration": 2, "box": [-1, 1]}) == []
    assert differences("problem", {"duration": 2.0}, {"duration": 3}) == ["problem: duration was 2.0, is 3"]
    assert len(differences("problem", {"on": True}, {"on": 1})) == 1


def test_other_versions_are_told_where_something_changed(folder, capsys):
    """They explain a change; alone they are none."""
    path = folder / "baselines" / "noisy.json"
    facts = json.loads(path.read_text())
    facts["versions"]["casadi"] = "3.7.2"
    path.write_text(signed(facts))
    assert main(["check", "noisy.py", "--no-compile"]) == 0
    assert "3.7.2" not in capsys.readouterr().out
    path.write_text(spoilt(lambda f: _metrics(f)["cycles"].update(value=299))(path))
    assert main(["check", "noisy.py", "--no-compile"]) == 5
    assert "measured with casadi 3.7.2 (now" in capsys.readouterr().out


def test_nothing_to_check_is_an_error(tmp_path, monkeypatch, capsys):
    """An empty folder must not look like success."""
    monkeypatch.chdir(tmp_path)
    assert main(["check"]) == 2
    assert "no problem to check" in capsys.readouterr().err


HOSTILE = (
    "<script>alert(1)</script>",
    "x | y `code` [a](http://b) @team #1 **bold** ![i](j)",
    "'; touch pwned; $(touch pwned) `touch pwned` \"",
    "a]]>&<!-- --><b attr='1'>\x00\x1b[31m\u202e\ud800\r\n::error::no",
)


class _Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.found = set()

    def handle_starttag(self, tag, attrs):
        self.found.add((tag, tuple(attrs)))


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_names_are_only_text(name):
    """Markdown holds no tag, link, mention or column of theirs."""
    row = Row(name, f"cost.{name}", 1.0, name, 0.1, "changed")
    judgement = Judgement(name, (row,), (f"stale: {name}",), "", name, name, (name,))
    page = to_markdown([judgement], {name: name})
    tags = _Tags()
    tags.feed(page)
    assert tags.found == {("code", ())}
    table = [line for line in page.splitlines() if line.startswith("|")]
    assert [line.count("|") for line in table] == [8, 8, 8]
    own = page.replace("<!-- fpirhc check -->", "").replace("### fpirhc", "")
    assert not set("@[]`$!#") & set(own.replace("&#", ""))
    page.encode("utf-8")


def test_hostile_names_from_file_to_report(tmp_path, monkeypatch, capsys):
    """A problem file and controllers with such names are blessed and checked; nothing is executed."""
    monkeypatch.chdir(tmp_path)
    stem = "$(touch pwned);<b>'x'|::y"
    controller = '"; touch pwned; <img src=x onerror=alert(1)>\\x1b[2J\\n::error::x'
    text = NOISY.replace('{"CTC"', f"{{'{controller}'")
    Path(f"{stem}.py").write_text(text)
    assert main(["accept", f"{stem}.py", "--reason", "<i>why</i>", "--no-compile"]) == 0
    Path(f"{stem}.py").write_text(text.replace("fp.Noise(2.0)", "fp.Noise(20.0)"))
    assert main(["check", "--no-compile", "--markdown", "a.md"]) == 6
    printed = capsys.readouterr().out
    assert "\x1b[2J" not in printed
    assert not any(line.strip().startswith("::") for line in printed.splitlines())
    assert "<img" not in Path("a.md").read_text()
    assert {p.name for p in tmp_path.iterdir()} == {f"{stem}.py", "baselines", "a.md"}
    assert main(["check", "--no-compile", "--markdown", "a.md"]) == 6, "reports replace reports"


def test_reports_say_what_changed(folder, capsys):
    text = (folder / "line.py").read_text()
    (folder / "line.py").write_text(text.replace("ca.sin(2 * t)", "1.1 * ca.sin(2 * t)"))
    assert main(["check", "line.py", "--no-compile", "--markdown", "a.md"]) == 5
    assert "rms_error.y" in capsys.readouterr().out
    page = Path("a.md").read_text()
    assert "0 of 1 problems hold" in page
    assert "<code>rms&#95;error.y</code>" in page


TEST = """
import pytest

@pytest.mark.parametrize("controller", ["CTC", "CTC+FPI", "RHC+FPI"])
def test_line(fpirhc_check, controller):
    fpirhc_check("line.py", controller)
"""


def test_pytest_plugin(pytester, blessed):
    """Missing, blessed by two workers, held, changed in one controller, and blessed for that one alone; with JUnit by pytest."""
    pytester.makepyfile(test_line=TEST)
    path = pytester.path / "line.py"
    path.write_text(LINE)
    run = lambda *more: pytester.runpytest_inprocess("--fpirhc-no-compile", "-p", "no:cacheprovider", *more)  # noqa: E731
    missing = run("-k", "RHC")
    missing.assert_outcomes(failed=1, deselected=2)
    missing.stdout.fnmatch_lines(["*there is no baseline 'line.json'*"])
    run("--fpirhc-accept", "first", "-n", "2").assert_outcomes(passed=3)
    file = pytester.path / "baselines" / "line.json"
    first = read_baseline(file)
    assert list(first.controllers) == ["CTC", "CTC+FPI", "RHC+FPI"], "in this order, whichever worker was first"
    assert first.controllers == read_baseline(blessed / "baselines" / "line.json").controllers
    path.write_text(
        LINE.replace('"CTC": fp.ComputedTorque(tracking)', '"CTC": fp.ComputedTorque(fp.Exponential(rate=9.0))')
    )
    changed = run("--junitxml", "a.xml")
    failures = Xml.parse(pytester.path / "a.xml").getroot().findall(".//failure")
    assert ["rms_error.y was 0." in (failure.get("message") or "") for failure in failures] == [True]
    changed.assert_outcomes(passed=2, failed=1)
    changed.stdout.fnmatch_lines(["*tracking.rate was 6.0, is 9.0*", "*rms_error.y was *: worse"])
    run("--fpirhc-accept", "faster", "-k", "line and not FPI").assert_outcomes(passed=1, deselected=2)
    second = read_baseline(file)
    assert second.reason == "faster"
    assert second.controllers["CTC"] != first.controllers["CTC"]
    assert second.controllers["RHC+FPI"] == first.controllers["RHC+FPI"]
    run().assert_outcomes(passed=3)
    path.write_text(f"{path.read_text()}\nmetrics = [fp.Metric('mine', lambda problem, run: 1 / 0)]\n")
    run("--fpirhc-accept", "a metric of its own").assert_outcomes(passed=3)
    broken = run("-k", "RHC", "-W", "default")
    broken.assert_outcomes(passed=1, warnings=1, deselected=2)
    broken.stdout.fnmatch_lines(["*line: RHC+FPI: metric 'mine'*ZeroDivisionError*"])
    # A function of another name has the same numbers; a renamed controller takes the place of the old one, with the old seed.
    path.write_text(
        LINE.replace(
            "plant =", "def rhs(q, v, u, p):\n    return {'y': p.b * u.u - p.k * q.y}\n\n\nplant =", 1
        ).replace('lambda q, v, u, p: {"y": p.b * u.u - p.k * q.y}', "rhs")
    )
    file.write_text(to_text(replace(first, seed=3)))
    run().assert_outcomes(passed=3)
    path.write_text(path.read_text().replace('"CTC":', '"slow":'))
    pytester.makepyfile(test_line=TEST.replace('"CTC",', '"slow",'))
    run("--fpirhc-accept", "renamed", "-k", "slow").assert_outcomes(passed=1, deselected=2)
    renamed = read_baseline(file)
    assert (list(renamed.controllers), renamed.seed) == (["CTC+FPI", "RHC+FPI", "slow"], 3)
    pytester.makepyfile(test_line=TEST)
    # A changed problem cannot be blessed for one of its controllers alone.
    path.write_text(LINE.replace("period=1e-3", "period=2e-3"))
    refused = run("--fpirhc-accept", "slower", "-k", "line and not FPI")
    assert refused.ret == pytest.ExitCode.TESTS_FAILED
    refused.stdout.fnmatch_lines(["*were not measured; its baseline is left as it is*"])
    assert read_baseline(file) == renamed


def test_pytest_plugin_wants_a_reason(pytester):
    """An empty one is refused before anything runs."""
    pytester.makepyfile(test_line=TEST)
    result = pytester.runpytest_inprocess("--fpirhc-accept", " ")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*needs a reason*"])
