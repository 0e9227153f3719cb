"""The records of a ledger as a folder of Parquet files, which grows while scenarios run."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from operator import itemgetter, methodcaller
from pathlib import Path
from typing import Any, Self

from fpirhc.errors import not_writable, package
from fpirhc.simulation.metrics import Metric
from fpirhc.studies.scenarios.ledger import Records
from fpirhc.studies.scenarios.scenario_comparison import FIELDS
from fpirhc.task.problem import Problem
from fpirhc.whole_file import whole_file

FOLDER = "scenarios.parquet"
ROWS = 10_000  # of a file
_KEY = b"fpirhc.records"  # in a file: what its records are known by
_ATTRIBUTES = b"PANDAS_ATTRS"  # where pandas keeps those of a table
_WORDS = {"name", "group", "controller", "outcome", "stop"}


class _Rows:
    """Rows as tuples, by the metrics and elements that their numbers have: numbers go into columns without being named."""

    def __init__(self, records: Iterable[Mapping[str, Any]] = ()) -> None:
        self.alike: dict[
            tuple[tuple[str, ...], ...], list[tuple[Any, ...]]
        ] = {}  # metrics first, then elements of each
        self.count = 0
        for record in records:
            self.add(record)

    def add(self, record: Mapping[str, Any]) -> None:
        metrics = record["metrics"]
        numbers = metrics.values()
        row = (*_fields(record), *chain.from_iterable(map(_values, numbers)))
        self.alike.setdefault((tuple(metrics), *map(tuple, numbers)), []).append(row)
        self.count += 1


_fields, _values = itemgetter(*FIELDS), methodcaller("values")


class ParquetFolder:
    """Files of `ROWS` rows each: number k has the records of a ledger from k `ROWS` on, in its order.

    The ledger decides: a file of other records than stand there is written anew. A process that is killed leaves whole files, and
    the next one adds what is missing. All files have the same columns when the folder is closed, and units as attributes.

    Args:
        folder: for the files; it is made.
        records: of the ledger, which go on growing.
        metrics: of the study.
        problem: of the study.

    Raises:
        NotInstalled: pyarrow is not there.
        OutputError: the folder cannot be written.
    """

    def __init__(self, folder: Path, records: Records, metrics: Sequence[Metric], problem: Problem) -> None:
        self._arrow = package("pyarrow", "parquet", "a table in Parquet")
        self._parquet = package("pyarrow.parquet", "parquet", "a table in Parquet")
        self._folder, self._records, self._problem = folder, records, problem
        self._metrics = {metric.name: metric for metric in metrics}
        self._units = dict.fromkeys(FIELDS, "")  # of the columns of all files
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise not_writable(folder, error, "--out") from None
        self._full = len(records) // ROWS  # number of files with all their rows
        for number in range(self._full):
            if not self._fits(number):
                self._write(number, _Rows(self._of(number)))
        self._rows = _Rows(self._of(self._full))  # of the next file

    def add(self, record: Mapping[str, Any]) -> None:
        """Take the record that the ledger took last."""
        self._rows.add(record)
        if self._rows.count == ROWS:
            self._write(self._full, self._rows)
            self._full, self._rows = self._full + 1, _Rows()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Write the last rows, and give files the columns that only later ones have."""
        if self._rows.count:
            self._write(self._full, self._rows)
        files = {self._path(number) for number in range(self._full + bool(self._rows.count))}
        for path in self._folder.glob("[0-9]*.parquet"):
            if path not in files:
                path.unlink()
            elif self._parquet.read_schema(path).names != list(self._units):
                table = self._parquet.read_table(path)
                self._save(path, [table], table.schema.metadata[_KEY])

    def _fits(self, number: int) -> bool:
        """Whether a file has the records that the ledger has at its place; its columns are known then."""
        try:
            schema = self._parquet.read_schema(self._path(number))
        except (OSError, self._arrow.ArrowInvalid):
            return False
        if schema.metadata.get(_KEY) != self._of(number).key:
            return False
        units = json.loads(schema.metadata[_ATTRIBUTES])["units"]
        self._units |= {name: units.get(name, "") for name in schema.names}
        return True

    def _write(self, number: int, rows: _Rows) -> None:
        tables = []
        for (metrics, *every), some in rows.alike.items():
            names = list(FIELDS)
            for metric, elements in zip(map(self._metrics.__getitem__, metrics), every, strict=True):
                for element in elements:
                    names.append(metric.key(element))
                    self._units.setdefault(names[-1], metric.unit_of(self._problem, element))
            columns = [self._arrow.array(c, self._kind(n)) for n, c in zip(names, zip(*some, strict=True), strict=True)]
            tables.append(self._arrow.table(columns, names))
        self._save(self._path(number), tables, self._of(number)[: rows.count].key)

    def _save(self, path: Path, tables: Sequence[Any], key: bytes) -> None:
        """Write a file with all columns; what a table lacks is empty."""
        units = {name: unit for name, unit in self._units.items() if unit not in ("", "1")}
        about = {_ATTRIBUTES: json.dumps({"units": units}), _KEY: key}
        schema = self._arrow.schema([(name, self._kind(name)) for name in self._units])
        with whole_file(path, "table") as file:
            whole = self._arrow.concat_tables([schema.empty_table(), *tables], promote_options="default")
            self._parquet.write_table(whole.replace_schema_metadata(about), file)

    def _kind(self, column: str) -> Any:
        """The type of a column."""
        whole = self._arrow.int64() if column == "scenario" else self._arrow.float64()
        return self._arrow.string() if column in _WORDS else whole

    def _of(self, number: int) -> Records:
        return self._records[number * ROWS : (number + 1) * ROWS]

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:06}.parquet"
