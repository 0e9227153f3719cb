"""Many controllers in many scenarios, each scenario the same for all of them; finished results are never lost or repeated."""

from __future__ import annotations

import heapq
import itertools
import time
from array import array
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fpirhc.errors import FpirhcError, InvalidValue, OutputError
from fpirhc.fields.checked import checked_call
from fpirhc.fields.kinds import Few, Seed
from fpirhc.problem_files.problem_file import Task
from fpirhc.problem_files.settings import Values
from fpirhc.simulation.metrics import Metric
from fpirhc.simulation.metrics.base import Column, known_metric
from fpirhc.studies.comparison.compare import check_gains, select
from fpirhc.studies.objective import Objective, objective
from fpirhc.studies.scenarios.bench import (
    SIDE_BY_SIDE,
    Bench,
    Conditions,
    RecordFields,
    is_of_judgements,
    scenario_numbers,
    scenarios,
)
from fpirhc.studies.scenarios.cluster import Cluster, Workers
from fpirhc.studies.scenarios.draws import COMPARING
from fpirhc.studies.scenarios.fingerprint import fingerprint
from fpirhc.studies.scenarios.ledger import Ledger, Records, begun_with, header_of
from fpirhc.studies.scenarios.paired import Record, Summary, noun, summarise, verdict
from fpirhc.studies.scenarios.parquet import FOLDER, ParquetFolder
from fpirhc.studies.scenarios.scenario_comparison import ScenarioComparison
from fpirhc.studies.scenarios.worker import Job, answered
from fpirhc.studies.tuned_file import with_tuned
from fpirhc.studies.view import Progress, circumstances

LEDGER = "scenarios.jsonl"
_BEGUN = "the results that the folder held before are such runs; another --out begins anew, side by side"


@checked_call
def compare_scenarios(
    task: Task,
    *,
    count: int | None = None,
    percent: float = 0.0,
    cases: Sequence[str] | None = None,
    shard: tuple[int, int] = (1, 1),
    seed: Seed,
    folder: Path,
    controllers: Sequence[str] | None = None,
    baseline: str | None = None,
    headline: str | None = None,
    processes: Few = 1,
    cluster: str | None = None,
    tuned: Mapping[str, Values] | None = None,
    tuning: Mapping[str, str] | None = None,
    compiled: bool = True,
    parquet: bool = False,
    command: str = "",
    progress: Progress | None = None,
) -> ScenarioComparison:
    """Run every controller in the same scenarios and return paired statistics; scenarios that `folder` holds are not run again.

    Args:
        task: the loaded problem file.
        count: number of random scenarios.
        percent: range of the exact parameters' draws around the problem's, percent.
        cases: in place of random scenarios, those cases of the task that these patterns name; see `Cases.matching`.
        shard: (k, n): every n-th of these scenarios, from the k-th on; `merge_shards` joins the folders.
        seed: of all draws.
        folder: folder to which finished scenarios are written, one by one.
        controllers: names of controllers; None: all.
        baseline: name of the controller with which the others are compared; None: the first.
        headline: number by which controllers are compared, 'in_band' or 'rms_error.q1'; None: the problem's, or the relative error.
        processes: number of processes; more than 1 need a task that is the same as its file.
        cluster: address of a scheduler of Dask, 'tcp://HOST:PORT', whose workers run the scenarios; 'local': a cluster of so many
            processes on this machine. It needs such a task too.
        tuned: settings to change, by controller and path.
        tuning: sentences about the origin of these settings, by controller.
        compiled: whether runs use compiled C.
        parquet: whether all finished scenarios of `folder` are written to its `scenarios.parquet` too, while they come.
        command: the command line, for the report.
        progress: function of (controller, scenarios done, scenarios in all) that is called after every scenario.

    Raises:
        InvalidName, InvalidValue: an unknown headline, or one without a better direction; a pattern without a case.
        InvalidProblem: unknown controllers or settings, gains of the wrong sign, draws that could leave physical
            bounds.
        OutputError: the folder cannot be written, or holds results under other conditions.
        NotSupported: Dask, or pyarrow for Parquet, is not installed.
        WorkerDied: processes die again and again, or the scheduler of a cluster is gone.
    """
    begin = time.perf_counter()
    figure = objective(task.headline_metric if headline is None else headline, task.metrics, task.problem)
    every = scenario_numbers(task, count, percent, cases)
    numbers = _of_shard(every, *shard)
    task = with_tuned(task, tuned or {})
    names = list(select(task, [*([baseline] if baseline else []), *(controllers or task.controllers)]))
    check_gains(task, select(task, names))
    many = compiled and len(every) >= SIDE_BY_SIDE  # of all parts, which are joined only where they ran alike
    # What was begun one by one is not mixed with the other.
    begun = bool(begun_with(folder / LEDGER, "side_by_side", many))
    conditions = Conditions(
        seed,
        COMPARING,
        float(percent),
        compiled,
        named=cases is not None,
        side_by_side=begun,
        judged=is_of_judgements(figure.metric),
    )
    bench, header = Bench(task, conditions), fingerprint(task, conditions)
    opening = {"path": str(task.path.resolve()), "tuned": tuned or {}, "conditions": asdict(conditions)}
    with Ledger(folder / LEDGER, header, RecordFields) as ledger, ExitStack() as closing_table:
        # a folder that is refused begins no cluster
        workers = _workers(opening, header, processes, cluster)
        adds = [ledger.append]
        if parquet:
            table = ParquetFolder(folder / FOLDER, ledger.records, task.metrics, task.problem)
            adds.append(closing_table.enter_context(table).add)
        records, skipped = _completed(ledger.records, adds, bench, workers, numbers, names, progress)
    summaries = _summaries(records, seed, task.metrics, figure)
    return ScenarioComparison(
        count=len(numbers),
        named=conditions.named,
        figure=figure,
        groups=_groups(records, seed, task.metrics, figure) if conditions.named else {},
        percent=float(percent),
        seed=seed,
        measure_from=task.problem.measure_from,
        time_unit=task.problem.time_unit,
        columns=_columns(task, summaries, figure),
        summaries=summaries,
        records=records,
        skipped=skipped,
        verdict=(*verdict(summaries, skipped, noun(conditions.named), figure), *_without_numbers(task, summaries)),
        tuning={n: note for n, note in (tuning or {}).items() if n in names},
        **circumstances(task, select(task, names), command, begin),
        pictures=task.pictures,
        apart=dict.fromkeys(records, _BEGUN)
        if many > begun
        else {n: w for n, w in bench.apart.items() if n in records},
        to_look_at={} if tuned else _to_look_at(task, conditions, summaries),
        units={
            metric.key(element): metric.unit_of(task.problem, element)
            for metric in task.metrics
            for one in summaries
            for element in one.metrics.get(metric.name, ())
        },
    )


def _workers(
    opening: Mapping[str, Any], header: Mapping[str, Any], processes: int, cluster: str | None
) -> Workers | Cluster | None:
    """Who runs the scenarios; None for this process alone."""
    if cluster is not None:
        return Cluster(cluster, opening, header, processes)
    return Workers(__package__ + ".worker", opening, header, processes) if processes > 1 else None


def _without_numbers(task: Task, summaries: Sequence[Summary]) -> list[str]:
    """A sentence for every metric of the problem file's own that no run has."""
    own = [metric.name for metric in task.metrics if known_metric(metric.name) is None]
    lacking = [name for name in own if summaries and not any(one.metrics.get(name) for one in summaries)]
    return [f"No run has metric '{name}'; where its function raises, fpirhc run tells why." for name in lacking]


def _to_look_at(
    task: Task, conditions: Conditions, summaries: Sequence[Summary]
) -> dict[str, dict[str, tuple[str, ...]]]:
    """Options of the runs of the worst, the median and the first failing scenario of every controller."""
    every = scenarios(task, conditions)
    found: dict[str, dict[str, tuple[str, ...]]] = {}
    for one in summaries:
        numbers = {"worst": one.worst_scenario, "median": one.median_scenario}
        numbers |= {} if one.first_ended is None else {"first that ended early": one.first_ended}
        found[one.name] = {f"{what} ({every[k].name})": every.options(k) for what, k in numbers.items()}
    return found


def _of_shard(numbers: Sequence[int], part: int, parts: int) -> Sequence[int]:
    """Every n-th of the scenarios."""
    if not 1 <= part <= parts:
        raise InvalidValue(f"shard {part}/{parts}: expected a part from 1 to {parts}")
    own = numbers[part - 1 :: parts]
    if not own:
        raise InvalidValue(
            f"shard {part}/{parts} of {len(numbers)} scenarios has none; use at most {len(numbers)} shards"
        )
    return own


def _completed(
    records: Records,
    adds: Sequence[Callable[[Record], None]],
    bench: Bench,
    workers: Workers | Cluster | None,
    numbers: Sequence[int],
    names: Sequence[str],
    progress: Progress | None,
) -> tuple[dict[str, Records], dict[str, str]]:
    """Run the jobs that the ledger lacks; return all records by controller in order, and the skipped with reasons."""
    places = {name: np.full(max(numbers) + 1, -1, dtype=np.int32) for name in names}
    for place, record in enumerate(records):
        if record["controller"] in places and record["scenario"] <= max(numbers):
            places[record["controller"]][record["scenario"]] = place
    wanted = np.asarray(numbers, dtype=np.int32)
    lacking = {name: wanted[places[name][wanted] < 0] for name in names}
    done = {name: len(wanted) - len(lacking[name]) for name in names}
    # Controllers take turns.
    jobs = heapq.merge(*(_jobs(bench, name, lacking[name]) for name in names), key=lambda job: job[0][0])
    skipped: dict[str, str] = {}
    # Closed whatever happens: the workers end with it.
    with closing(_answers(bench, workers, jobs)) as answers:
        for record in answers:
            name = record["controller"]
            if "skipped" in record:
                skipped[name] = record["skipped"]
            else:
                for add in adds:
                    add(record)
                places[name][record["scenario"]] = len(records) - 1
            done[name] += 1
            if progress:
                progress(name, done[name], len(numbers))
    return {n: records.at(places[n][wanted]) for n in names if n not in skipped}, skipped


def _jobs(bench: Bench, name: str, numbers: np.ndarray) -> Iterator[Job]:
    return ((block, name) for block in bench.blocks(name, numbers))


def _answers(bench: Bench, workers: Workers | Cluster | None, jobs: Iterable[Job]) -> Generator[dict[str, Any]]:
    """Records of the jobs in the order in which they come; without workers this process runs the jobs."""
    if workers is None:
        for numbers, name in jobs:
            yield from bench.records(numbers, name)
        return
    groups = (list(group) for _, group in itertools.groupby(jobs, key=_together))
    with workers:
        for record in itertools.chain.from_iterable(workers.answers(groups, lambda some: answered(bench, some))):
            if "error" in record and "scenario" not in record:
                raise FpirhcError(record["error"])
            yield record


def _together(job: Job) -> object:
    """What jobs have in common that one worker does: scenarios side by side, which it draws once for all controllers."""
    numbers, name = job
    return numbers if len(numbers) > 1 else (numbers, name)


def _groups(
    records: Mapping[str, Records], seed: int, metrics: Sequence[Metric], figure: Objective
) -> dict[str, tuple[Summary, ...]]:
    """The summaries of every group of scenarios; none where no scenario has a group."""
    names = sorted({str(r["group"]) for some in records.values() for r in some} - {""})
    return {
        name: _summaries(
            {c: some.at(k for k, r in enumerate(some) if r["group"] == name) for c, some in records.items()},
            seed,
            metrics,
            figure,
        )
        for name in names
    }


def _summaries(
    records: Mapping[str, Records], seed: int, metrics: Sequence[Metric], figure: Objective
) -> tuple[Summary, ...]:
    if not records:
        return ()
    first, *others = records
    against = [(first, None), *((name, records[first]) for name in others)]
    return tuple(summarise(name, records[name], before, seed, metrics, figure) for name, before in against)


def _columns(task: Task, summaries: Sequence[Summary], figure: Objective) -> tuple[Column, ...]:
    """The numbers of a short table; that of the comparison has columns of its own."""
    return tuple(
        Column(metric, element, metric.unit_of(task.problem, element))
        for metric in task.metrics
        if metric.headline
        for element in dict.fromkeys(e for one in summaries for e in one.metrics.get(metric.name, {}))
        if (metric, element) != (figure.metric, figure.element)
    )


@dataclass(frozen=True)
class Joined:
    """What a folder holds after its parts were joined."""

    records: int  # number of results, those from before included
    controllers: tuple[str, ...]  # their names
    scenarios: int  # number of different scenarios
    twice: int  # results that were there already


def merge_shards(folders: Sequence[Path], out: Path) -> Joined:
    """Join the results of several folders; what stands in two of them is kept once.

    `out`: folder of the whole; it may hold some results already.

    Args:
        folders: of parts of one comparison of scenarios.
        out: folder of the whole; it may hold some results already.

    Raises:
        InvalidValue: the folder of the whole stands among those of the parts.
        OutputError: a folder without results, results under other conditions, or one result that differs between two folders.
    """
    if out.resolve() in {folder.resolve() for folder in folders}:
        raise InvalidValue(
            f"'{out}' is the folder of the whole and of a part; it keeps the results that it holds, so leave it out of the parts"
        )
    header, twice = header_of(folders[0] / LEDGER), 0
    with Ledger(out / LEDGER, header, RecordFields) as whole:
        known = _Places()
        for place, record in enumerate(whole.records):
            known.put(record, place)
        for folder in folders:
            header_of(folder / LEDGER)  # a folder without results is named, and gets none
            with Ledger(folder / LEDGER, header, RecordFields) as part:
                for record in part.records:
                    before = known.of(record)
                    if before is None:
                        known.put(record, len(whole.records))
                        whole.append(record)
                    elif _result(whole.records[before]) == _result(record):
                        twice += 1
                    else:
                        raise OutputError(
                            f"'{folder / LEDGER}': scenario {record['scenario']} of '{record['controller']}' has another result "
                            "than in another folder; run this part again on one of the machines"
                        )
        return Joined(len(whole.records), known.controllers, known.scenarios, twice)


class _Places:
    """Where records stand among others, by controller and scenario, four bytes each."""

    def __init__(self) -> None:
        self._by_name: dict[
            str, array[int]
        ] = {}  # by controller; the place after a scenario's, and 0 where there is none

    @property
    def controllers(self) -> tuple[str, ...]:
        """Names in the order of their first records."""
        return tuple(self._by_name)

    @property
    def scenarios(self) -> int:
        """Number of different scenarios."""
        there = np.zeros(max(map(len, self._by_name.values()), default=0), dtype=bool)
        for places in self._by_name.values():
            there[: len(places)] |= np.frombuffer(places, places.typecode) > 0
        return int(there.sum())

    def of(self, record: Mapping[str, Any]) -> int | None:
        """Return the place of the record with this one's controller and scenario."""
        places, number = self._by_name.get(record["controller"], ()), record["scenario"]
        return places[number] - 1 if number < len(places) and places[number] else None

    def put(self, record: Mapping[str, Any], place: int) -> None:
        """Set the place of a record."""
        places, number = self._by_name.setdefault(record["controller"], array("I")), record["scenario"]
        places.frombytes(bytes(max(0, number + 1 - len(places)) * places.itemsize))
        places[number] = place + 1


def _result(record: Mapping[str, Any]) -> dict[str, Any]:
    """What does not depend on the machine's speed."""
    return {name: value for name, value in record.items() if name != "lasted"}
