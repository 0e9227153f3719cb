"""Says what pip-audit answered: `audit_answer.py FOUND.json SAID.txt`; exit code 1 where it knows of a vulnerability.

pip-audit calls a package that its data does not know 'skipped', and then finds nothing. Where it knows none of the packages that a
run needs, it has reached no data, and silence would be no answer.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

NEEDED = ("numpy", "casadi")


def main(found: Path, said: Path) -> int:
    """Print the answer and return the exit code."""
    try:
        packages = json.loads(found.read_text(encoding="utf-8"))["dependencies"]
    except (OSError, ValueError, KeyError):
        last = (said.read_text(encoding="utf-8").strip().splitlines() or ["no word"])[-1]
        print(f"audit: skipped, pip-audit gave no answer: {last}")
        return 0
    known = {one["name"]: one.get("vulns", []) for one in packages if "skip_reason" not in one}
    weak = {name: [v["id"] for v in vulns] for name, vulns in known.items() if vulns}
    for name, ids in weak.items():
        print(f"audit: {name} has known vulnerabilities: {', '.join(ids)}", file=sys.stderr)
    if weak:
        return 1
    if not any(name in known for name in NEEDED):
        print(
            f"audit: skipped, the data that pip-audit reached knows neither of {', '.join(NEEDED)}: {len(known)} of {len(packages)}"
        )
        return 0
    print(
        f"audit: no known vulnerabilities in {len(known)} of {len(packages)} packages; the others are not in the data"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
