"""What a table of runs says: every controller beside the first one, variant by variant, and where each is worst."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fpirhc.errors import listed
from fpirhc.fields.checked import checked_call
from fpirhc.plant.motion import with_space
from fpirhc.problem_files.problem_file import Task, pair_of
from fpirhc.simulation.metrics import known_metrics
from fpirhc.studies import Progress, Study, View, circumstances
from fpirhc.studies.compare import check_gains, select
from fpirhc.studies.runs import run_variants
from fpirhc.studies.variants import CasesOf, Draws, Variants
from fpirhc.studies.verdict import Objective, Outcome, chatter, objective
from fpirhc.summary import Column, Table, in_percent, written_out

_TAIL, _MOVES = 0.025, "total_variation."  # on either side of an interval; the metric of movement
_ABREAST, _EVEN = 2, 1e-6  # panels of a picture; by how much equal steps of an axis differ
_CLEAR = {Outcome.BETTER: "is better than", Outcome.WORSE: "is worse than", Outcome.DOUBTFUL: "doubtfully beats"}
_CLEAR[Outcome.MIXED] = "has mixed results beside"


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class VariantStudy(Study):
    """The result of `study`.

    Args:
        table: a row per controller and variant, see `run_variants`.
        summary: a row per controller: worst, worst_in, failures, median, difference to the first one (the median of the paired
            ones), its 95 % interval from low to high, in how many variants it is better, and medians over runs that finished:
            'total_variation.INPUT' per unit of time, and the main metrics of the file.
        groups: the same of every group of cases.
        figure: the number that is judged.
        variants: of the study.
        places: all controllers of the file, in its order, from which their colours follow.
        chatter: of every controller whose command chatters somewhere, by variant how many times its partner's movement it has.
    """

    table: pd.DataFrame
    summary: pd.DataFrame
    groups: dict[str, pd.DataFrame]
    figure: Objective
    variants: Variants
    places: tuple[str, ...]
    chatter: dict[str, dict[str, float]]

    @property
    def count(self) -> int:
        """Number of variants."""
        return len(self.table) // len(self.summary)

    @property
    def view(self) -> View:
        title = f"{self.problem}: {self.count} variants"
        tables = [self._shown(name, some) for name, some in {title: self.summary, **self.groups}.items()]
        facts: Any = {"problem": self.problem, "variants": str(self.variants), "metric": self.figure.column}
        facts["summary"] = self.summary.reset_index().to_dict("records")
        facts["groups"] = {g: some.reset_index().to_dict("records") for g, some in self.groups.items()}
        facts |= {"chatter": self.chatter, "versions": self.versions}
        shares = " Errors are rms, in % of the range of the reference, and differences are in percentage points."
        shares *= self.figure.metric is None
        lists = {"Worst runs": [*_commands(self)]}
        return View(self, [*_sentences(self)], f"{self.variants}.{shares}", tables, facts, lists)

    def _shown(self, title: str, summary: pd.DataFrame) -> Table:
        noun, first, units = self.figure.column, summary.index[0], self.table.attrs["units"]
        medians = [name for name in map(str, summary) if name in self.table and name != noun]
        heads = ["controller", f"worst {noun}", f"worst {self.variants.place}", "failures", f"median {noun}"]
        heads += [f"against {first}", "95 % interval"]
        heads += [f"{n.replace(_MOVES, 'variation ')} [{units.get(n, '1')}]" for n in medians]
        shown = Table(title, [*map(Column, heads), Column("better in", None)])  # the verdict has it
        text, apart = self.figure.text, self.figure.difference
        for row in _rows(summary):
            better = f"{row.better} of {row.variants}" if row.controller != first else ""
            numbers = [text(row.worst), row.worst_in, str(row.failures), text(row.median)]
            numbers += [apart(row.difference), apart(row.low, row.high)]
            moved = [written_out(v) if math.isfinite(v := summary[name][row.controller]) else "" for name in medians]
            shown.add([row.controller, *numbers, *moved, better])
        return shown.filled


@checked_call
def study(
    task: Task,
    variants: Variants,
    *,
    controllers: Sequence[str] | None = None,
    metric: str | None = None,
    processes: int | None = None,
    compiled: bool = True,
    folder: Path | None = None,
    command: str = "",
    progress: Progress | None = None,
) -> VariantStudy:
    """Run every controller in every variant and compare them with the first one, variant by variant.

    Args:
        task: a problem with its controllers.
        variants: `CasesOf`, `Draws` or `Grid`.
        controllers: names, the first of which the others are compared with; None: all, the headline's first.
        metric: the number that is judged; None: the problem's, or the relative error.
        processes: number of processes, see `run_variants`.
        compiled: whether loops run as compiled C.
        folder: where rows are kept, so that the same call goes on after an interruption.
        command: that reproduces it.
        progress: called with (controller, done, in all).
    """
    first = [] if controllers else [*(task.headline or ())]
    begin, chosen = time.perf_counter(), select(task, controllers or [*dict.fromkeys([*first, *task.controllers])])
    check_gains(task, chosen)
    aim = objective(task.headline_metric if metric is None else metric, task.metrics, task.problem)
    how: dict[str, Any] = {"processes": processes, "compiled": compiled, "progress": progress}
    own, keep = aim.needed(task.metrics), folder and folder / "runs.jsonl"
    table = run_variants(task, variants, controllers=list(chosen), metrics=own, keep=keep, **how)
    named, known = table.loc[table.group != ""], known_metrics()
    also = tuple(one.name for one in task.metrics if one.main and one not in known)
    groups = {str(g): summarised(some, aim, also) for g, some in named.groupby("group", sort=False)}
    facts = circumstances(task, chosen, command, begin)
    facts |= {"chatter": _chatter(table, task), "places": (*task.controllers,)}
    summary = summarised(table, aim, also)
    return VariantStudy(table=table, summary=summary, groups=groups, figure=aim, variants=variants, **facts)


def _chatter(table: pd.DataFrame, task: Task) -> dict[str, dict[str, float]]:
    """How many times as much as its partner a controller moves, by variant, where its command goes to and fro."""
    good: Any = {(r["controller"], r["variant"]): r for r in table.to_dict("records") if r["outcome"] == "finished"}
    pairs, found = {name: pair_of(task.controllers, name) for name, _ in good}, dict[str, dict[str, float]]()
    for (name, variant), own in good.items():
        plain = good.get((pairs[name], variant))
        if plain and (times := chatter(own, plain, task.problem)):
            found.setdefault(name, {})[variant] = times
    return found


def summarised(table: pd.DataFrame, aim: Objective, also: Sequence[str] = ()) -> pd.DataFrame:
    """Return a row per controller, see `VariantStudy`. A run that failed is worse than every other one."""
    every = (dict(zip(map(str, table), row, strict=True)) for row in table.itertuples(index=False))
    values = table.assign(value=[*map(aim.value, every)])
    wide = values.pivot(index="variant", columns="controller", values="value")
    wide = wide.loc[[*dict.fromkeys(table.variant)], [*dict.fromkeys(table.controller)]]
    failures = (table.outcome != "finished").groupby(table.controller).sum()
    medians = [column for column in map(str, table) if column.startswith((_MOVES, *also))]
    middles = table.loc[table.outcome == "finished"].groupby("controller")[medians].median()
    first, rows = wide.iloc[:, 0].to_numpy(), {}
    for name in map(str, wide):
        own, baseline = wide[name].to_numpy(), name == wide.columns[0]
        both = np.isinf(own) & np.isinf(first)
        apart = np.where(both, 0.0, own - np.where(both, 0.0, first))
        low, high = (math.nan, math.nan) if baseline else interval(apart)
        rows[name] = {
            "worst": aim.sign * own.max(),
            "worst_in": wide.index[int(own.argmax())],
            "failures": int(failures[name]),
            "median": aim.sign * middle(own),
            "difference": math.nan if baseline else aim.sign * middle(apart),
            "low": min(aim.sign * low, aim.sign * high),
            "high": max(aim.sign * low, aim.sign * high),
            "better": int((own < first).sum()),
            "variants": len(own),
            **{column: float(middles[column].get(name, math.nan)) for column in medians},
        }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("controller")


def middle(values: np.ndarray) -> float:
    """Return the median; an infinite number lies beyond all others, and half-way between the two infinities is zero."""
    ordered = np.sort(values)
    low, high = float(ordered[(len(ordered) - 1) // 2]), float(ordered[len(ordered) // 2])
    return 0.0 if low == -high else (low + high) / 2


def interval(values: np.ndarray) -> tuple[float, float]:
    """Return the interval of order statistics that holds the median of any distribution at least 95 times of 100.

    Below six values there is none, and both ends are NaN.
    """
    from scipy.special import bdtr  # scipy.stats takes a second to import

    count = len(values)
    beyond = int((bdtr(np.arange(count // 2 + 1), count, 0.5) <= _TAIL).sum())
    ordered = np.sort(values)
    return (float(ordered[beyond - 1]), float(ordered[count - beyond])) if beyond else (math.nan, math.nan)


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a share of which `count` of `total` were seen; at 0 and 1 all of it is on one side."""
    from scipy.special import betaincinv

    tail = 2 * _TAIL if count in (0, total) else _TAIL
    low = 0.0 if count == 0 else float(betaincinv(count, total - count + 1, tail))
    return low, 1.0 if count == total else float(betaincinv(count + 1, total - count, 1 - tail))


def _sentences(result: VariantStudy) -> Iterator[tuple[str, Outcome | None]]:
    aim, summary = result.figure, result.summary
    than, most = ("smaller", "smallest") if aim.sign > 0 else ("larger", "largest")
    for row in _rows(summary.iloc[1:]):
        medians = f"the median is {aim.text(row.median)}, with {summary.index[0]} {aim.text(summary['median'].iloc[0])}"
        share = f"in {row.better} of {row.variants} variants; {medians}.{''.join(_moved(result, row.controller))}"
        ends = sorted((aim.sign * row.low, aim.sign * row.high))
        more = row.failures > (failures := summary.failures.iloc[0])
        better = Outcome.DOUBTFUL if row.controller in result.chatter else Outcome.BETTER
        better = Outcome.MIXED if more else better
        clear = better if ends[1] < 0 else Outcome.WORSE if ends[0] > 0 else Outcome.NO_DIFFERENCE
        fails = f"it fails in {row.failures} variants, {summary.index[0]} in {failures}; " * (clear is Outcome.MIXED)
        what = f"{_CLEAR.get(clear, 'is not clearly different from')} {summary.index[0]}"
        said = f"{what}: {fails}its {aim.column} is {than}"
        if few := math.isnan(row.low):  # for an interval
            said = f"has a {than} {aim.column} than {summary.index[0]}"
        yield f"{row.controller} {said} {share}", None if few else clear
    axes = getattr(result.variants, "axes", {})
    for name, some in result.table.groupby("controller", sort=False) if axes else ():
        good = some.loc[some.outcome == "finished"]
        if len(good) and good[aim.column].nunique() > 1:
            best = int((aim.sign * good[aim.column]).to_numpy().argmin())
            number, place = aim.text(good[aim.column].iloc[best]), good.variant.iloc[best]
            yield f"{name}: the {most} {aim.column} is {number}, at {place}.", None
    failed = result.table.loc[result.table.outcome != "finished"].groupby("controller").first()
    why = {
        r.controller: f" The first is variant {r.variant}: {r.outcome}{r.why and ': '}{r.why}" for r in _rows(failed)
    }
    calm = [row.controller for row in _rows(summary) if not row.failures]
    for row in _rows(summary):
        low, high = share_interval(row.failures, row.variants)
        others = f": of all plants drawn so {in_percent(low)} to {in_percent(high)} fail, with 95 % confidence"
        drawn, names = others if result.variants.random else "", [row.controller] if row.failures else calm
        if (drawn or row.failures) and row.controller == names[0]:
            text = f"{listed(names)} fail{'s' * (len(names) == 1)} in {row.failures} of {row.variants} variants{drawn}."
            yield text + why.get(row.controller, ""), None


def _moved(result: VariantStudy, name: str) -> Iterator[str]:
    """What a controller pays: the inputs that move more than twice as much as with the first controller; where they chatter."""
    for column, moved in result.summary.filter(like=_MOVES).items():
        if moved[name] > 2 * moved.iloc[0]:
            what, unit = str(column).removeprefix(_MOVES), result.table.attrs["units"].get(column, "1")
            own, first = (f"{written_out(v)}{with_space(unit)}" for v in (moved[name], moved.iloc[0]))
            yield f" The total variation of {what} is {own}, with {result.summary.index[0]} {first}."
    if chatter := sorted(result.chatter.get(name, {}).items(), key=lambda one: -one[1]):
        which = f"{', '.join(variant for variant, _ in chatter[:4])}{', ...' * (len(chatter) > 4)}"
        times = written_out(chatter[0][1])
        yield f" It chatters in {len(chatter)} variants ({which}): its total variation is up to {times} times its partner's."


def _rows(frame: pd.DataFrame) -> Iterator[Any]:
    return iter(frame.reset_index().itertuples())


def _commands(result: VariantStudy) -> Iterator[str]:
    """The command that makes the worst run of every controller once more."""
    seeds = result.table.set_index(["controller", "variant"])["seed"].to_dict()
    file = next((word for word in shlex.split(result.command) if Path(word).stem == result.problem), result.problem)
    for row in _rows(result.summary):
        words, of = ["fpirhc", "run", file, row.controller], result.variants
        if isinstance(of, Draws):
            words += ["--draw", row.worst_in, "--mismatch", f"{of.percent:.17g}", "--seed", str(of.seed)]
        elif isinstance(of, CasesOf):
            words += ["--case", row.worst_in, "--seed", str(seeds[row.controller, row.worst_in])]
        else:
            continue
        yield shlex.join(words)


def figure_of(result: VariantStudy) -> Any:
    """Return the picture of a study: lines or maps over the settings of a grid, else the sorted values of every controller."""
    from fpirhc.simulation.drawing import colours_of, draw_legend, literal, new_figure

    axes, table = getattr(result.variants, "axes", {}), result.table
    column, units = result.figure.column, table.attrs["units"]
    with_unit = {name: f"{name} [{units[name]}]" if name in units else name for name in (column, *axes)}
    with_unit |= {"error": "rms error [% of the range of the reference]"}
    shown = table.assign(shown=(1 if result.figure.metric else 100) * table[column].where(table.outcome == "finished"))
    names = list(dict.fromkeys(table.controller))
    if len(axes) == 2:
        rows, abreast = -(-len(names) // _ABREAST), min(len(names), _ABREAST)
        figure = new_figure(4.6 * abreast, 3.9 * rows, f"{result.problem}: {column}")
        (x, y), [*panels] = axes, figure.subplots(rows, abreast, squeeze=False).flat
        least, largest = shown.shown.min(), shown.shown.max()
        for spare in panels[len(names) :]:
            spare.remove()
        for panel, name in zip(panels, names, strict=False):
            cells = shown[shown.controller == name].pivot(index=y, columns=x, values="shown")
            mesh = panel.pcolormesh(cells.columns, cells.index, cells, shading="nearest", vmin=least, vmax=largest)
            panel.set(title=literal(name), xlabel=literal(with_unit[x]), ylabel=literal(with_unit[y]))
            _scale(panel.set_xscale, axes[x])
            _scale(panel.set_yscale, axes[y])
        figure.colorbar(mesh, ax=panels[: len(names)], label=with_unit[column])
        return figure
    figure = new_figure(7, 4, f"{result.problem}: {column}")
    axis = figure.subplots()
    colours = colours_of(result.places)
    for name in names:
        own = shown[shown.controller == name]
        across = own[next(iter(axes))] if axes else np.linspace(0, 100, len(own))
        axis.plot(across, own.shown if axes else np.sort(own.shown), ".-", color=colours[name], label=literal(name))
    if shown.shown.min() > 0:
        axis.set_yscale("log")
        few = shown.shown.max() < 20 * shown.shown.min()  # ticks, which all have their numbers
        shown_as = lambda value, _: written_out(value)  # noqa: E731
        axis.yaxis.set(major_formatter=shown_as, minor_formatter=shown_as if few else "")
    axis.set(xlabel="share of the variants [%]", ylabel=with_unit[column])
    for name, values in axes.items():
        axis.set_xlabel(literal(with_unit[name]))
        _scale(axis.set_xscale, values)
    draw_legend(axis)
    return figure


def _scale(set_scale: Callable[..., None], values: Sequence[float]) -> None:
    """Make an axis of a grid logarithmic where its values have equal ratios, and neither equal steps nor different signs."""
    sizes, more = np.abs(values), {} if min(values) > 0 else {"linthresh": min(map(abs, values)) or 1.0}
    one_sign = len(values) > 2 and values[0] * values[-1] > 0
    if one_sign and np.ptp(np.diff(np.log(sizes))) < _EVEN < np.ptp(np.diff(sizes)):
        set_scale("symlog" if more else "log", **more)
