"""Runs every attack and writes the figures to docs/reliability.md: `python tests/attack/make_reliability.py`."""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))
PAGE = ROOT / "docs" / "reliability.md"
FLIPS, KILLS = 400, 30

TEXT = """# Reliability

What a machine must survive, attacked and counted. This page is made by `python tests/attack/make_reliability.py`; the tests in
`tests/attack` run a share of it, and all of it with `-m slow`.

| attack | tried | raw errors | commands not finite or outside limits | controllers frozen | not equal to the tick left out |
|---|---|---|---|---|---|
{rows}

{controllers} shipped controllers of {problems} problems, each through a `Stepper`, for 80 cycles and the faults of
`tests/attack/faults.py`. A controller is frozen when it still skips every cycle, or does not move its command, long
after the fault has ended. A single bad sample must give the same commands, bit for bit, as the tick left out. After
{lost} faults the simulated plant itself has left its domain (a tank below its bottom); these are not judged for freezing.

| attack on files | tried | unnoticed or failed |
|---|---|---|
| one flipped bit in a compiled library or its checksum | {flips} | {unnoticed} |
| a process killed while it compiles; the next one needs the library | {kills} | {failed} |

{wrong}
"""


def main() -> None:
    """Run everything and write the page."""
    from attack.faults import FAULTS
    from attack.files import flipped_bits, killed_compilations
    from attack.harness import PROBLEMS, Bench, shipped

    tried, raw, outside, frozen, differs = (Counter[str]() for _ in range(5))
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
            if outcome.wrong:
                wrong.append(f"- {label}, {fault.name}: {outcome.wrong}")
        print(label, flush=True)
    counters = (tried, raw, outside, frozen, differs)
    rows = []
    for fault in FAULTS:
        numbers = [str(c[fault.name]) for c in counters[:4]] + [str(differs[fault.name]) if fault.single else "–"]
        rows.append(f"| {fault.name} | {' | '.join(numbers)} |")
    rows.append("| **all** | " + " | ".join(f"**{sum(c.values())}**" for c in counters) + " |")
    with tempfile.TemporaryDirectory() as folder:
        unnoticed = flipped_bits(Path(folder) / "flips", FLIPS, seed=1)
        failed = killed_compilations(Path(folder) / "kills", KILLS, seed=1)
    facts = {"controllers": controllers, "problems": len(PROBLEMS), "lost": lost, "flips": FLIPS, "kills": KILLS}
    words = "\n".join(["What went wrong:", "", *wrong]) if wrong else "Nothing went wrong."
    PAGE.write_text(
        TEXT.format(rows="\n".join(rows), unnoticed=unnoticed, failed=failed, wrong=words, **facts), encoding="utf-8"
    )


if __name__ == "__main__":
    main()
