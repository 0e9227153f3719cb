"""Records in columns: a million of them take some 200 MB, where as many dictionaries take 4.5 GB."""

from __future__ import annotations

import json
from array import array
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, overload

_SMALL = (("b", 2**7), ("i", 2**31), ("q", 2**63))  # types of whole numbers, and their ends
_MEMORY = 1000  # texts that are looked for before they are stored once more

Path = tuple[str, ...]
Form = tuple[tuple[Path, str], ...]  # of every entry: its place, and the type of its column; "" for None


class _Table:
    """The columns of all records that have the same entries."""

    def __init__(self, form: Form) -> None:
        self.form = form
        self._columns = [array(kind) for _, kind in form if kind]
        self.size = 0

    def append(self, values: Sequence[Any]) -> None:
        for column, value in zip(self._columns, values, strict=True):
            column.append(value)
        self.size += 1

    def row(self, number: int) -> Iterator[Any]:
        return (column[number] for column in self._columns)


class _Texts:
    """Texts one after the other, the usual ones once."""

    def __init__(self) -> None:
        self._all, self._places = bytearray(), dict[str, int]()

    def place(self, text: str) -> int:
        if text not in self._places:
            if len(self._places) >= _MEMORY:
                self._places.pop(next(iter(self._places)))
            self._places[text] = len(self._all)
            self._all += text.encode() + b"\0"
        return self._places[text]

    def at(self, place: int) -> str:
        return self._all[place : self._all.index(b"\0", place)].decode()


class _Store:
    """Tables of all forms that came."""

    def __init__(self) -> None:
        self._tables: dict[Form, int] = {}
        self._of: list[_Table] = []
        self._texts = _Texts()
        self._table, self._row = array("I"), array("I")

    def append(self, record: Mapping[str, Any]) -> int:
        entries = [(path, *self._stored(value)) for path, value in _leaves(record, ())]
        form = tuple((path, kind) for path, kind, _ in entries)
        if form not in self._tables:
            self._tables[form] = len(self._of)
            self._of.append(_Table(form))
        table = self._tables[form]
        self._table.append(table)
        self._row.append(self._of[table].size)
        self._of[table].append([value for _, kind, value in entries if kind])
        return len(self._row) - 1

    def _stored(self, value: Any) -> tuple[str, Any]:
        """The type of the value's column, and what stands there; "I" and "L" are places of texts and of other values' JSON."""
        if value is None:
            return "", None
        if isinstance(value, float):
            return "d", value
        if isinstance(value, str) and "\0" not in value:
            return "I", self._texts.place(value)
        if isinstance(value, int) and not isinstance(value, bool):
            for kind, end in _SMALL:
                if -end <= value < end:
                    return kind, value
        return "L", self._texts.place(json.dumps(value))

    def read(self, place: int) -> dict[str, Any]:
        table, record = self._of[self._table[place]], dict[str, Any]()
        values = table.row(self._row[place])
        for path, kind in table.form:
            value: Any = next(values) if kind else None
            if kind in ("I", "L"):
                text = self._texts.at(value)
                value = text if kind == "I" else json.loads(text)
            inside = record
            for name in path[:-1]:
                inside = inside.setdefault(name, {})
            inside[path[-1]] = value
        return record


class Records(Sequence[Mapping[str, Any]]):
    """Records in their order; each is a new dictionary, equal to the one that was appended."""

    def __init__(self) -> None:
        self._store, self._places = _Store(), array("I")

    def append(self, record: Mapping[str, Any]) -> None:
        """Add a record: names with numbers, texts, None, lists, or such mappings."""
        self._places.append(self._store.append(record))

    def at(self, places: Sequence[int]) -> Records:
        """Return some of the records, which share the columns of all."""
        some = Records()
        some._store, some._places = self._store, array("I", (self._places[k] for k in places))
        return some

    @overload
    def __getitem__(self, place: int) -> Mapping[str, Any]: ...
    @overload
    def __getitem__(self, place: slice) -> Records: ...
    def __getitem__(self, place: int | slice) -> Mapping[str, Any] | Records:
        if isinstance(place, slice):
            return self.at(range(len(self))[place])
        return self._store.read(self._places[place])

    def __len__(self) -> int:
        return len(self._places)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Records | list)
            and len(self) == len(other)
            and all(a == b for a, b in zip(self, other, strict=True))
        )

    __hash__ = None  # type: ignore[assignment]  # as a list

    def __repr__(self) -> str:
        return repr(list(self))


def _leaves(value: Mapping[str, Any], path: Path) -> Iterator[tuple[Path, Any]]:
    """Every entry that is no mapping with names, with its path."""
    for name, one in value.items():
        here = (*path, name)
        if isinstance(one, Mapping) and one and all(isinstance(key, str) for key in one):
            yield from _leaves(one, here)
        else:
            yield here, one
