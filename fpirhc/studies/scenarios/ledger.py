"""An append-only file of results that survives being killed at any moment.

Every line is one JSON object; the first one has the conditions of the results, the last entry of each its checksum, 'sum'. A line
is with the system before `append` returns, and on the disk a second or 100 records later. A torn last line is cut off. Only one
process may have the file open.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Self, overload

import numpy as np

from fpirhc.errors import InvalidField, OutputError
from fpirhc.fields.checked import Checked, field_names


class Records(Sequence[Mapping[str, Any]]):
    """Records of a file in their order; each is read where it is asked for.

    What stays in memory is the place of a line and its checksum, twelve bytes: a file that was begun anew has other lines there.

    Args:
        path: of the file.
        places: of the records' lines, in bytes from the start.
        sums: CRC-32 of the lines.
    """

    def __init__(self, path: Path, places: Iterable[int] = (), sums: Iterable[int] = ()) -> None:
        self._path, self._places, self._sums = path, array("Q", places), array("I", sums)

    def append(self, place: int, line: bytes) -> None:
        """Add the record of the line that starts there."""
        self._places.append(place)
        self._sums.append(zlib.crc32(line))

    def at(self, numbers: Iterable[int]) -> Records:
        """Return some of the records."""
        chosen = np.fromiter(numbers, dtype=np.intp)
        return Records(
            self._path, *(np.frombuffer(one, one.typecode)[chosen].tolist() for one in (self._places, self._sums))
        )

    @property
    def key(self) -> bytes:
        """What these records, and no others, are known by."""
        return f"{len(self)} {zlib.crc32(self._sums.tobytes()):08x}".encode()

    def __iter__(self) -> Iterator[Mapping[str, Any]]:
        try:
            file = self._path.open("rb")
        except OSError as error:
            raise OutputError(
                f"cannot read '{self._path}': {error.strerror}; records stay in the folder of their study, so keep it as long as "
                "they are read"
            ) from None
        with file:
            at = 0
            for place, known in zip(self._places, self._sums, strict=True):
                if place != at:
                    file.seek(place)
                line = file.readline()
                at = place + len(line)
                if zlib.crc32(line) != known:
                    raise OutputError(
                        f"'{self._path}' holds the results of another study by now, and these records are gone; give every study a "
                        "folder of its own with --out"
                    )
                record = _parsed(self._path, line)
                record.pop(_SUM, None)
                yield record

    @overload
    def __getitem__(self, place: int) -> Mapping[str, Any]: ...
    @overload
    def __getitem__(self, place: slice) -> Records: ...
    def __getitem__(self, place: int | slice) -> Mapping[str, Any] | Records:
        if isinstance(place, slice):
            return self.at(range(len(self))[place])
        return next(iter(self.at([place])))

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


_SUM = "sum"  # entry with the checksum of a line
_BLOCK = 2**20  # bytes that are read at once
_GROUP, _WAIT = 100, 1.0  # records and seconds after which what was written is forced to the disk


class Ledger:
    """The open file; `records` are those that it held and those appended, in this order.

    Args:
        record: class whose fields every record has; None: records are not checked.

    Raises:
        OutputError: the file cannot be written, is damaged, is in use, or holds results under other conditions.
    """

    def __init__(self, path: Path, header: Mapping[str, Any], record: type[Checked] | None = None) -> None:
        self._path, self._record = path, record
        self._waiting, self._forced, self._end = 0, time.monotonic(), 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # a disk that is full shows in the write itself, and never when the file is closed
            self._file = path.open("a+b", buffering=0)
        except OSError as error:
            raise OutputError(f"cannot write to '{path}': {error.strerror}; choose another folder with --out") from None
        try:
            _lock(self._file, path)
            self.records = self._read(json.loads(json.dumps(header)))
        except BaseException:
            self._file.close()
            raise

    def append(self, record: Mapping[str, Any]) -> None:
        """Write one record; every so often, wait until all are on the disk."""
        place = self._end
        self.records.append(place, self._write(record))

    def close(self) -> None:
        """Force all to the disk and close the file; another process may open it then."""
        try:
            self._force()
        finally:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write(self, value: Mapping[str, Any]) -> bytes:
        """The line of it."""
        line = _line(value)
        try:
            written = self._file.write(line)
            while written < len(line):
                written += self._file.write(line[written:])
        except OSError as error:
            raise self._full(error) from None
        self._end += len(line)
        self._waiting += 1
        if self._waiting >= _GROUP or time.monotonic() - self._forced >= _WAIT:
            self._force()
        return line

    def _force(self) -> None:
        """Wait until everything that was written is on the disk."""
        try:
            if self._waiting:
                os.fsync(self._file.fileno())
        except OSError as error:
            raise self._full(error) from None
        self._waiting, self._forced = 0, time.monotonic()

    def _full(self, error: OSError) -> OutputError:
        return OutputError(
            f"cannot write to '{self._path}': {error.strerror}; finished results are kept, and the same command continues from them"
        )

    def _read(self, header: dict[str, Any]) -> Records:
        """The records, one line after the other; a torn last line is cut off."""
        records, summed = Records(self._path), True
        for number, text in enumerate(self._whole_lines(), 1):
            if number == 1 or not summed or not _is_as_written(text):
                what = (
                    "remove the line, and its result is computed again"
                    if number > 1
                    else "remove the file to begin again"
                )
                line = _parsed(self._path, text, f", line {number}", what)
                if number == 1:
                    summed = _SUM in line
                else:
                    self._check(number, line)
                if summed and line.pop(_SUM, "") != _sum(line):
                    raise OutputError(f"'{self._path}', line {number} is damaged: its checksum does not fit; {what}")
                if number == 1 and line != header:
                    raise OutputError(_refusal(self._path, line, header))
            if number > 1:
                records.append(self._end, text)
            self._end += len(text)
        if self._end != self._file.seek(0, os.SEEK_END):
            self._file.truncate(self._end)
        if not self._end:
            self._write(header)
            self._force()
            _sync_folder(self._path.parent)
        return records

    def _whole_lines(self) -> Iterator[bytes]:
        self._file.seek(0)
        begun = b""
        while block := self._file.read(_BLOCK):
            *lines, begun = (begun + block).split(b"\n")
            yield from (line + b"\n" for line in lines)

    def _check(self, number: int, line: Mapping[str, Any]) -> None:
        """Refuse a record that lacks a field, or has one of a wrong type; other fields may stand beside them."""
        if self._record is None:
            return
        names = field_names(self._record)
        try:
            self._record(**{name: value for name, value in line.items() if name in names})
        except InvalidField as error:
            raise OutputError(
                f"'{self._path}', line {number} is damaged: {error.text}; remove the line, and its result is computed again"
            ) from None


@contextlib.contextmanager
def kept_in(
    path: Path | None, header: Callable[[], Mapping[str, Any]], record: type[Checked]
) -> Iterator[tuple[Sequence[Mapping[str, Any]], Callable[[Mapping[str, Any]], None]]]:
    """Open a ledger, and yield its records and its `append`; without a path there are none, and nothing is kept."""
    if path is None:
        yield (), lambda _: None
        return
    with Ledger(path, header(), record) as ledger:
        yield ledger.records, ledger.append


def header_of(path: Path) -> dict[str, Any]:
    """Return the conditions of the results in a file."""
    try:
        with path.open("rb") as file:
            text = file.readline()
    except OSError as error:
        raise OutputError(
            f"cannot read '{path}': {error.strerror}; expected the folder of a comparison of scenarios"
        ) from None
    try:
        value = json.loads(text)
        header = {name: one for name, one in value.items() if name != _SUM}
        whole = value.get(_SUM) == _sum(header)
    except (ValueError, AttributeError):
        whole = False
    if not whole:
        raise OutputError(f"'{path}', line 1 is damaged; run this part again")
    return header


def begun_with(path: Path, name: str, other: Any) -> Any:
    """Return a condition of the results that a file holds; another value where it holds none that can be read."""
    with contextlib.suppress(OutputError):
        return header_of(path).get(name, other)
    return other


def _parsed(path: Path, text: bytes, where: str = "", what: str = "remove the file to begin again") -> dict[str, Any]:
    try:
        value = json.loads(text)
    except ValueError:
        value = None
    if not isinstance(value, dict):
        raise OutputError(f"'{path}'{where} is damaged; {what}")
    return value


def _line(value: Mapping[str, Any]) -> bytes:
    """With its checksum."""
    text = _text(value)
    return f'{text[:-1]}{"," if value else ""}"{_SUM}":"{_checksum(text.encode())}"}}\n'.encode()


def _is_as_written(line: bytes) -> bool:
    """Whether not one byte differs from what `_line` wrote; such a line need not be understood."""
    rest, _, end = line.rpartition(f',"{_SUM}":"'.encode())
    return end == f'{_checksum(rest + b"}")}"}}\n'.encode()


def _text(value: Mapping[str, Any]) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))


def _sum(value: Mapping[str, Any]) -> str:
    """Checksum of an object; numbers are read and written alike to the last bit."""
    return _checksum(_text(value).encode())


def _checksum(text: bytes) -> str:
    """Eight hexadecimal digits."""
    return f"{zlib.crc32(text):08x}"


def _refusal(path: Path, header: dict[str, Any], wanted: dict[str, Any]) -> str:
    names = [n for n in dict.fromkeys([*wanted, *header]) if header.get(n) != wanted.get(n)]
    facts = "; ".join(f"{n} {_fact('was', header, n)}, {_fact('is', wanted, n)}" for n in names)
    return (
        f"'{path}' holds results of something else, and results are never mixed: {facts}. "
        "Give another folder with --out, or remove the file"
    )


def _fact(verb: str, header: Mapping[str, Any], name: str) -> str:
    """What a header says of a fact, which one of another version may not know."""
    return f"{verb} {_short(header[name])}" if name in header else f"{verb} not stated"


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:12]}...{text[-4:]}"


def _lock(file: IO[bytes], path: Path) -> None:
    """Hold the file until it is closed or this process ends, however it ends."""
    if sys.platform == "win32":
        return
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OutputError(
            f"'{path}' is in use by another run; wait for it, or choose another folder with --out"
        ) from None
    except OSError:
        return  # some network file systems cannot lock


def _sync_folder(folder: Path) -> None:
    """Write the name of a new file to the disk too, on systems that allow it."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
