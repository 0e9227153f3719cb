"""Runs every attack and prints the figures: `python benchmarks/reliability.py`, with names of sections these alone."""

from __future__ import annotations

import statistics
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]  # also for processes that are started
FLIPS, KILLS, MISTAKES, LINES = 400, 30, 10_000, 1000


def loop() -> str:
    """Faults of sensors, actuators, clocks and memories, for every shipped controller."""
    from helpers.attack.faults import FAULTS
    from helpers.attack.harness import PROBLEMS, Bench, shipped

    tried, raw, outside, frozen, differs = (Counter[str]() for _ in range(5))
    away: dict[str, list[float]] = {fault.name: [] for fault in FAULTS}
    wrong, controllers, lost = [], 0, 0
    for label, problem, controller in shipped():
        bench, controllers = Bench(problem, controller), controllers + 1
        for fault in FAULTS:
            outcome = bench.outcome(fault)
            tried[fault.name] += 1
            raw[fault.name] += bool(outcome.raw)
            outside[fault.name] += outcome.outside
            frozen[fault.name] += outcome.frozen
            differs[fault.name] += outcome.differs
            lost += bench.lost
            away[fault.name].append(outcome.deviation)
            if outcome.wrong:
                wrong.append(f"{label}, {fault.name}: {outcome.wrong}")
        print(label, file=sys.stderr, flush=True)
    counters = (tried, raw, outside, frozen, differs)
    rows = [["attack", "tried", "raw errors", "commands not finite or outside limits", "controllers frozen"]]
    rows[0] += ["not equal to the tick left out", "deviation, median", "deviation, worst tenth"]
    for fault in FAULTS:
        rows.append([fault.name, *(str(c[fault.name]) for c in counters[:4])])
        rows[-1].append(str(differs[fault.name]) if fault.single else "–")
        rows[-1] += [f"{q:.2g}" for q in statistics.quantiles(away[fault.name], n=10)[4::4]]
    rows.append(["**all**", *(f"**{sum(c.values())}**" for c in counters), "", ""])
    return f"""{_table(rows)}

{controllers} shipped controllers of {len(PROBLEMS)} problems, each through a `Stepper`, for 80 cycles and the faults of
`tests/helpers/attack/faults.py`. A controller is frozen when it still skips every cycle, or does not move its command, long
after the fault has ended. A single bad sample must give the same commands, bit for bit, as the tick left out. After
{lost} faults the simulated plant itself has left its domain (a tank below its bottom); these are not judged for freezing.
The deviation is that of the command from the run without faults, in normal movements of the command per cycle (the larger of their
median and their mean in that run): the median of the controllers, and what one in ten exceeds. At the start nothing is known before
the first good sample, and the command is the one before the run, where the other run jumps to its first one. So deviations count
from the end of such a fault on: what remains is that the plant moved meanwhile. A command that rests in the run without faults has
movements of a millionth of its size, so there a small deviation is a large number of them.

{_what_went(wrong)}"""


def files() -> str:
    """Flipped bits of everything that is read again, and killed compilations."""
    from helpers.attack.artefacts import ARTEFACTS, flipped
    from helpers.attack.files import killed_compilations

    rows = [["attack", "tried", "raw errors", "unnoticed or failed"]]
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in ARTEFACTS:
            result = flipped(name, Path(folder) / name, FLIPS, seed=1)
            rows.append([f"one flipped bit in a {name}", str(FLIPS), str(len(result.raw)), str(result.unnoticed)])
            wrong += result.raw
        failed = killed_compilations(Path(folder) / "kills", KILLS, seed=1)
        what = "a process killed while it compiles; the next one needs the library"
        rows.append([what, str(KILLS), "0", str(failed)])
    return f"{_table(rows)}\n\n{_what_went(wrong)}"


def problems() -> str:
    """Problem files with mistakes."""
    from mutated_problems import raw_error

    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        ends = [raw_error(Path(folder) / "mine.py", 1000 + k) for k in range(MISTAKES)]
    wrong = [end for end in ends if end]
    rows = [["problem files with one to three mistakes", "raw errors"], [str(MISTAKES), str(len(wrong))]]
    return f"{_table(rows)}\n\n{_what_went(wrong)}"


SECTIONS: dict[str, tuple[str, Callable[[], str]]] = {
    "loop": ("The loop", loop),
    "files": ("Files and processes", files),
    "problems": ("Problem files", problems),
}


def main(names: Sequence[str]) -> None:
    """Run the named sections, or all, and print each."""
    for unknown in set(names) - set(SECTIONS):
        sys.exit(f"section '{unknown}' is unknown; there are {', '.join(SECTIONS)}")
    for name in names or SECTIONS:
        title, make = SECTIONS[name]
        print(f"## {title}\n\n{make()}\n", flush=True)


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])


def _what_went(wrong: Sequence[str]) -> str:
    return "\n".join(["What went wrong:", "", *(f"- {one}" for one in wrong)]) if wrong else "Nothing went wrong."


if __name__ == "__main__":
    main(sys.argv[1:])
