"""The result of a comparison, and what every output says of it: sentences, tables of controllers and plans, remarks, facts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fpirhc.errors import InvalidName, nearest
from fpirhc.fields.checked import FoundByName
from fpirhc.plant.motion import SECONDS
from fpirhc.simulation.metrics import Metric, Metrics
from fpirhc.simulation.metrics.base import Column as Number
from fpirhc.simulation.metrics.base import columns, in_report
from fpirhc.simulation.pictures.base import Picture
from fpirhc.studies.comparison.changes import Finding, Outcome
from fpirhc.studies.comparison.entry import Entry
from fpirhc.studies.comparison.optimality import gap
from fpirhc.studies.comparison.pairwise import NullTest
from fpirhc.studies.view import Study, View, status_shares
from fpirhc.summary import Column, Table, in_percent, line, numbers_written_out, written_out

_SOLVES = "solve."  # metrics of plans, which have a table of their own


@dataclass(frozen=True, eq=False, kw_only=True)
class Comparison(Study, FoundByName):
    """The result of `compare`.

    Args:
        seed: of the disturbances and the noise.
        measure_from: time from which errors count.
        entries: the controllers that ran, in order.
        skipped: reasons why controllers were skipped, by name.
        findings: the verdict, sentence by sentence with outcomes; the headline pair is first.
        pictures: pictures of the problem for the report.
        nulls: what adaptation does where there is nothing to adapt, for every pair.
        time_unit: unit of time of the problem.
        steps: whether the plant is a map, which has no motion between two cycles.
        information: what the controllers are given, what each uses, and when each acts, in sentences.
    """

    seed: int
    measure_from: float
    entries: tuple[Entry, ...]
    skipped: Mapping[str, str]
    findings: tuple[Finding, ...]
    pictures: tuple[Picture, ...] = ()
    nulls: tuple[NullTest, ...] = ()
    time_unit: str = "s"
    steps: bool = False
    information: tuple[str, ...] = ()

    @property
    def verdict(self) -> tuple[str, ...]:
        """The verdict in sentences."""
        return tuple(finding.text for finding in self.findings)

    @property
    def outcome(self) -> Outcome:
        """What the first sentence states."""
        return self.findings[0].outcome or Outcome.NOT_COMPARABLE

    @property
    def planning(self) -> tuple[str, ...]:
        """A sentence for every controller that plans: at which rate, and which share of a period the plan takes."""
        return tuple(_planning(e) for e in self.entries if e.metrics.solve)

    @property
    def null(self) -> NullTest | None:
        """The null test of the pair that the first sentence is about; None without one."""
        return next((test for test in self.nulls if test.pair == self.findings[0].pair), None)

    @property
    def sentences(self) -> tuple[tuple[str, Outcome | None], ...]:
        """The verdict with outcomes: the findings, the null test of the first pair, and every other one that shows harm."""
        shown = (test for test in self.nulls if test is self.null or test.harmful)
        tests = ((test.text, Outcome.WORSE if test.harmful else None) for test in shown)
        return (*((finding.text, finding.outcome) for finding in self.findings), *tests)

    def __repr__(self) -> str:
        counts = f"{len(self.entries)} controllers" + (f", {len(self.skipped)} skipped" if self.skipped else "")
        return line(self, self.problem, f"seed {self.seed}", counts, self.verdict[0])

    @property
    def view(self) -> View:
        return _view(self)

    def __getitem__(self, name: str) -> Entry:
        for entry in self.entries:
            if entry.name == name:
                return entry
        raise InvalidName(
            f"controller '{name}' is not in this comparison.{nearest(name, [e.name for e in self.entries])}"
        )


def _view(comparison: Comparison) -> View:
    entries = comparison.entries
    ended = [f"{e.name} ended early: {e.run.stop}" for e in entries if e.run.stop]
    notes = [f"{e.name}: {note}" for e in entries for note in e.notes]
    since, marked = _since(comparison), _marked(comparison)
    return comparison.viewed(
        sentences=comparison.sentences,
        conditions=f"Errors, effort and cost from t = {since} on; seed {comparison.seed}. Marked are the best of: {marked}.",
        tables=(_controllers(comparison), _plans(comparison)),
        lists={
            head: [numbers_written_out(text) for text in texts]
            for head, texts in (
                ("Ended early", ended),
                ("What they measure, and how often", comparison.information),
                ("When they plan", comparison.planning),
                ("Notes", notes),
            )
        },
        skipped=comparison.skipped,
        facts=_facts(comparison),
    )


def _since(comparison: Comparison) -> str:
    return f"{comparison.measure_from:g} {comparison.time_unit}"


def _marked(comparison: Comparison) -> str:
    """Headings of the metrics whose best numbers are marked."""
    shown = columns([e.metrics for e in comparison.entries], lambda m: m.headline and m.better != "neither")
    return ", ".join(dict.fromkeys(c.metric.heading for c in shown))


def _controllers(comparison: Comparison) -> Table:
    """Metrics, time of a cycle, and how the runs ended; the best numbers are those of runs that did not end early."""
    entries = comparison.entries
    shown = columns([e.metrics for e in entries], lambda m: in_report(m) and not m.name.startswith(_SOLVES))
    finished = [e for e in entries if e.run.stop is None]
    best = {c: c.best([c.number(e.metrics) for e in finished]) for c in shown if c.metric.headline}
    heads = [Column(c.heading, c.short if c.metric.headline else None) for c in shown]
    table = Table(
        f"{comparison.problem}, from t = {_since(comparison)}, seed {comparison.seed}",
        [Column("controller"), *heads, Column("cycle [us]", "cycle us"), Column("status", left=True)],
    )
    for e in entries:
        time = _micro(e.cycle.median) if e.cycle else ""
        status = "ended early" if e.run.stop else status_shares(e.metrics.statuses)
        marked = [k for k, c in enumerate(shown, 1) if best.get(c) is not None and c.number(e.metrics) == best[c]]
        table.add([e.name, *(_text(c, e) for c in shown), time, status], best=marked)
    return table.filled


def _text(column: Number, entry: Entry) -> str:
    return column.text(column.number(entry.metrics), missing="", none="none")


def _plans(comparison: Comparison) -> Table:
    """Iterations and residuals of controllers that plan, cost above the converged optimum, times of their cycles."""
    planners = [e for e in comparison.entries if e.metrics.solve]
    solves = columns([e.metrics for e in planners], _of_plans)
    table = Table(
        "plans",
        [
            Column("controller"),
            *(Column(c.heading, c.metric.short or None) for c in solves),
            Column("gap"),
            Column("worst gap", None),
            Column("plan [us]", "plan us"),
            Column("p99 [us]", "p99 us"),
            Column("max [us]", "max us"),
            Column("first [us]", "first us"),
        ],
        "; ".join(
            [
                *(["gap: cost above the converged optimum, relative"] if any(e.optimality for e in planners) else []),
                *(
                    ["plan: median of the cycles that plan; p99, max: of all cycles"]
                    if any(e.cycle for e in planners)
                    else []
                ),
            ]
        ),
    )
    for e in planners:
        gaps = [gap(v, 1) for v in (e.optimality.median, e.optimality.worst)] if e.optimality else ["", ""]
        cycle = e.cycle
        times = [_micro(v) for v in (cycle.planning, cycle.p99, cycle.maximum, cycle.first)] if cycle else [""] * 4
        table.add([e.name, *(_text(c, e) for c in solves), *gaps, *times])
    return table.filled


def _planning(entry: Entry) -> str:
    """At which rate a controller plans, and which share of the period a cycle that plans takes."""
    run, every = entry.run, entry.plan_every
    rate = "in every cycle" if every == 1 else f"every {every} cycles"
    text = f"{entry.name} plans {rate}, every {every * run.period:.4g} {run.time_unit}"
    if entry.cycle is None:
        return f"{text}; the run is too short to time a plan"
    share = _share(entry)
    text = f"{text}; a cycle that plans takes {_micro(entry.cycle.planning)} us"
    if share is None:
        return text
    late = ": plans are late on this machine" if share > 1 else ""
    return f"{text}, {in_percent(share)} of a period{late}"


def _share(entry: Entry) -> float | None:
    """Share of the period that a cycle with a plan takes; None where it was not timed, or the unit of time is no clock's."""
    second = SECONDS.get(entry.run.time_unit)
    return 1e-6 * entry.cycle.planning / (second * entry.run.period) if entry.cycle and second else None


def _of_plans(metric: Metric) -> bool:
    return metric.name.startswith(_SOLVES) and (metric.report or bool(metric.short))


def _micro(value: float) -> str:
    return f"{value:,.0f}".replace(",", " ") if value >= 100 else written_out(value)


def _facts(comparison: Comparison) -> dict[str, Any]:
    return {
        "problem": comparison.problem,
        "seed": comparison.seed,
        "versions": comparison.versions,
        "verdict": comparison.verdict,
        "outcome": str(comparison.outcome),
        "information": comparison.information,
        "findings": [_finding(f) for f in comparison.findings],
        "null_test": None if comparison.null is None else _null_test(comparison.null),
        "null_tests": [_null_test(test) for test in comparison.nulls],
        "controllers": {e.name: _entry(e) for e in comparison.entries},
        "skipped": comparison.skipped,
    }


def _finding(finding: Finding) -> dict[str, Any]:
    return {
        "text": finding.text,
        "outcome": None if finding.outcome is None else str(finding.outcome),
        "pair": finding.pair,
        "ratios": finding.ratios,
    }


def _null_test(null: NullTest) -> dict[str, Any]:
    return {
        "passed": null.passed,
        "harmful": null.harmful,
        "outcome": str(null.outcome),
        "pair": null.pair,
        "rms_error": {"before": null.before, "after": null.after},
        "cycles": null.cycles,
        "elapsed_s": null.elapsed,
        "text": null.text,
    }


def _entry(entry: Entry) -> dict[str, Any]:
    times = {"median": "median", "p99": "p99", "max": "maximum", "first": "first", "planning": "planning"}
    return {
        **_numbers(entry.metrics),
        "cycle_us": _fields(entry.cycle, times),
        "statuses": dict(entry.metrics.statuses),
        "plans": {"cycles": entry.plan_every, "share_of_period": _share(entry)} if entry.metrics.solve else None,
        "optimality": _fields(entry.optimality, ("median", "worst", "plans", "stuck")),
        "price_us": _fields(entry.price, ("beside", "difference", "noise")),
        "notes": entry.notes,
        "measures": entry.information.uses if entry.information else None,
        "acts": entry.information.rate if entry.information else None,
        "stop": entry.run.stop,
        "compiled": entry.run.compiled,
    }


def _fields(value: object, names: Sequence[str] | dict[str, str]) -> dict[str, Any] | None:
    """Attributes by name, or by the name that the file has for them; None where there is no value."""
    own = names if isinstance(names, dict) else {name: name for name in names}
    return None if value is None else {name: getattr(value, attribute) for name, attribute in own.items()}


def _numbers(metrics: Metrics) -> dict[str, Any]:
    """Every metric by name, null or empty where the run has no such number; metrics of a group stand inside it."""
    facts: dict[str, Any] = {}
    for name, metric in metrics.entries.items():
        numbers: Any = dict(metrics[name]) if metric.by else metrics[name].get("")
        group, _, rest = name.partition(".")
        if not rest:
            facts[name] = numbers
        elif numbers is not None:
            facts[group] = {**(facts.get(group) or {}), rest: numbers}
        else:
            facts.setdefault(group, None)
    return facts
