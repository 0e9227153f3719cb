"""Results of one study that several machines computed in parts, joined into one folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fpirhc.errors import OutputError
from fpirhc.studies.scenarios.bench import RecordFields
from fpirhc.studies.scenarios.ledger import Ledger, header_of
from fpirhc.studies.scenarios.scenario_study import LEDGER


@dataclass(frozen=True)
class Joined:
    """What a folder holds after its parts were joined.

    Args:
        records: number of results, those from before included.
        controllers: their names.
        scenarios: number of different scenarios.
        twice: results that were there already.
    """

    records: int
    controllers: tuple[str, ...]
    scenarios: int
    twice: int


def merge_shards(folders: Sequence[Path], out: Path) -> Joined:
    """Join the results of several folders; what stands in two of them is kept once.

    Args:
        folders: of parts of one comparison of scenarios.
        out: folder of the whole; it may hold some results already.

    Raises:
        OutputError: a folder without results, results under other conditions, or one result that differs between two folders.
    """
    header = header_of(folders[0] / LEDGER)
    with Ledger(out / LEDGER, header, RecordFields) as whole:
        known = {_key(record): record for record in whole.records}
        twice = 0
        for folder in folders:
            header_of(folder / LEDGER)  # a folder without results is named, and gets none
            with Ledger(folder / LEDGER, header, RecordFields) as part:
                for record in part.records:
                    key = _key(record)
                    if key not in known:
                        whole.append(record)
                        known[key] = record
                    elif _result(known[key]) == _result(record):
                        twice += 1
                    else:
                        name, number = key
                        raise OutputError(
                            f"'{folder / LEDGER}': scenario {number} of '{name}' has another result than in another folder; run "
                            "this part again on one of the machines"
                        )
        names = tuple(dict.fromkeys(name for name, _ in known))
        return Joined(len(known), names, len({number for _, number in known}), twice)


def _key(record: Mapping[str, Any]) -> tuple[str, int]:
    return record["controller"], record["scenario"]


def _result(record: Mapping[str, Any]) -> dict[str, Any]:
    """What does not depend on the machine's speed."""
    return {name: value for name, value in record.items() if name != "lasted"}
