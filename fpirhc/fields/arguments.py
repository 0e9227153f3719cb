"""The arguments of a call: their names, what the annotations expect of them, and every mistake of one call."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, get_origin

from fpirhc.errors import nearest
from fpirhc.fields.expected import Anything, Expected, accepts, expected_by
from fpirhc.fields.given import call_of, described
from fpirhc.fields.mending import mistakes_in


@dataclass(frozen=True)
class Arguments:
    """The arguments of a class or a function.

    Args:
        owner: what is called.
        noun: what an argument of it is called, "field" or "argument".
        positional: names of those that may be given by their place.
        required: names of those without a default.
        expected: what is expected of each, by name.
        open: whether more arguments are taken than are named.
    """

    owner: type | Callable[..., object]
    noun: str
    positional: tuple[str, ...]
    required: tuple[str, ...]
    expected: Mapping[str, Expected]
    open: bool

    def mistakes(self, arguments: Sequence[object], named: Mapping[str, object]) -> Iterator[str]:
        """Yield every mistake of a call."""
        values = dict(zip(self.positional, arguments, strict=False))
        yield from self._wrong_names(arguments, values, named)
        every = {**values, **named}
        wrong = [n for n, value in every.items() if n in self.expected and not accepts(self.expected[n], value)]
        if self._swapped(wrong, every):
            name, (one, other) = self.owner.__name__, wrong
            yield f"{name}: the values of '{one}' and '{other}' are swapped; write {name}({one}=..., {other}=...)"
            return
        for name in wrong:
            yield from mistakes_in(self.expected[name], f"{self.owner.__name__}.{name}", every[name])

    def _swapped(self, wrong: Sequence[str], values: Mapping[str, object]) -> bool:
        """Whether two values are wrong, and each is what is expected of the other."""
        if len(wrong) != 2:
            return False
        one, other = wrong
        return accepts(self.expected[one], values[other]) and accepts(self.expected[other], values[one])

    def _wrong_names(
        self, arguments: Sequence[object], values: Mapping[str, object], named: Mapping[str, object]
    ) -> Iterator[str]:
        name = self.owner.__name__
        for key in named:
            if key in values:
                yield f"{name}: '{key}' is given twice, by its place and by its name"
            elif key not in self.expected and not self.open:
                yield f"{name} has no {self.noun} '{key}'.{nearest(key, self.expected)}"
        if len(arguments) > len(self.positional) and not self.open:
            extra = described(arguments[len(self.positional)])
            yield f"{name} takes {len(self.positional)} values without a name, got {len(arguments)}; {extra} is too many"
        missing = [key for key in self.required if key not in values and key not in named]
        if missing:
            yield f"{name} needs {', '.join(missing)}; write {call_of(self.owner)}"


def arguments_of(
    owner: type | Callable[..., object],
    noun: str,
    parameters: Sequence[inspect.Parameter],
    expected: Callable[[inspect.Parameter], Expected],
) -> Arguments:
    """Return the arguments of a call with these parameters; `expected` reads the annotation of one."""
    ours = [p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    return Arguments(
        owner,
        noun,
        tuple(p.name for p in ours if p.kind is not p.KEYWORD_ONLY),
        tuple(p.name for p in ours if p.default is p.empty),
        {p.name: expected(p) for p in ours},
        open=len(ours) < len(parameters),
    )


def read_annotation(annotation: object, names: Mapping[str, object], own: Mapping[str, object]) -> Expected:
    """Return what an annotation expects, read with the names of its module and of its class."""
    if isinstance(annotation, str):
        try:
            annotation = eval(annotation, dict(names), dict(own))
        except Exception:  # noqa: BLE001 -- a name for type checkers only: such an argument is not checked
            return Anything()
    if annotation is inspect.Parameter.empty or get_origin(annotation) is ClassVar:
        return Anything()
    return expected_by(annotation)
