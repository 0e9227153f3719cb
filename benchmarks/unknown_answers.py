"""Counts what reviews of the shipped problems leave unknown: `python benchmarks/unknown_answers.py [PROBLEM...]`.

Cautions, which are known and no reason to stop, are counted by problem beside them.
"""

from __future__ import annotations

import sys
from collections import Counter

import fpirhc as fp
from fpirhc.problem_files.shipped import missing, shipped_groups
from fpirhc.review.question import Answer, Verdict

REASONS = {
    "no linear loop": "no linear loop",
    "not informative": "commands at a limit",
    "is answered no": "another answer is no",
    "no run": "nothing can be run",
    "plant outside": "the plant is outside",
    "plant is outside": "the plant is outside",
}


def main(names: list[str]) -> None:
    """Print the counts."""
    every = [n for group in shipped_groups().values() for n, path in group.items() if not missing(path)]
    counts: Counter[tuple[str, str]] = Counter()
    for name in names or every:
        task = fp.load_problem(name)
        review = fp.review(task.problem, task.controllers, mismatch=0.0, seed=0)
        unknown = [(a.question, reason(a)) for a in review.answers if a.verdict == Verdict.UNKNOWN]
        counts.update(unknown)
        cautions = sum(a.verdict == Verdict.CAUTION for a in review.answers)
        print(f"{name:24s} {len(unknown)} unknown and {cautions} cautions of {len(review.answers)}", flush=True)
    for (question, why), count in sorted(counts.items(), key=lambda one: (one[0][0], -one[1])):
        print(f"{count:4d}  {question:62s} {why}")
    print(f"{sum(counts.values()):4d}  in all")


def reason(answer: Answer) -> str:
    """Return why an answer is unknown."""
    return next((why for words, why in REASONS.items() if words in answer.evidence), "nothing decides")


if __name__ == "__main__":
    main(sys.argv[1:])
