"""What is found by its name: a mapping whose missing names are one clear error with the nearest valid one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NoReturn, TypeVar, cast

from fpirhc.errors import InvalidName, nearest

Value = TypeVar("Value")


class ByName(dict[str, Value]):
    """A dictionary with names as keys; dictionaries in it are such ones too.

    Raises:
        InvalidName: a name that is not there.
    """

    def __init__(self, entries: Mapping[str, Value] | Iterable[tuple[str, Value]], where: str = "the mapping") -> None:
        """Copy the entries; `where` is the subject of the error: "Task.controllers"."""
        super().__init__(entries)
        self._where = where
        for name, value in self.items():
            if type(value) is dict:  # not a subclass, which may have an order or a default of its own
                super().__setitem__(name, cast(Value, ByName(cast(dict[str, object], value), f"{where}[{name!r}]")))

    def __getitem__(self, name: str) -> Value:
        try:
            return super().__getitem__(name)
        except TypeError:  # a list or a slice
            self.__missing__(name)

    def __missing__(self, name: object) -> NoReturn:
        raise InvalidName(f"{self._where} has no '{name}'.{nearest(name, self)}")


class FoundByName:
    """Base of dataclasses whose dictionaries are found by name."""

    def __post_init__(self) -> None:
        """Let every dictionary in a public field be found by name."""
        find_by_name(self)


def find_by_name(value: object) -> None:
    """Let every dictionary in a public attribute of a value be found by name."""
    for name, content in list(getattr(value, "__dict__", {}).items()):
        if type(content) is dict and not name.startswith("_") and all(isinstance(key, str) for key in content):
            object.__setattr__(value, name, ByName(content, f"{type(value).__name__}.{name}"))
