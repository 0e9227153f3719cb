"""The contract of a number that stands for a symbol, such as a setting that may change while a controller runs."""

from __future__ import annotations

from abc import ABC


class SymbolicNumber(ABC):  # noqa: B024 -- a marker without methods
    """A number that is a symbol while blocks are built. Checks of fields accept it wherever they accept a number.

    A bare CasADi symbol is no such number and is refused: nobody would give it a value.
    """
