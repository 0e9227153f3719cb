"""The commands: every module of `fpirhc.cli.verbs`, and entry points `fpirhc.verbs` of other packages."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import EntryPoint, entry_points

from fpirhc.cli.verb import Verb
from fpirhc.members import within

GROUP = "fpirhc.verbs"


@dataclass(frozen=True)
class Known:
    """A command that exists.

    Args:
        name: its name.
        summary: its line in `fpirhc --help`.
        group: the group there.
        load: function that loads it.
    """

    name: str
    summary: str
    group: str
    load: Callable[[], Verb]


@cache
def shipped() -> dict[str, Verb]:
    """Return the commands of this package by name: the value `VERB` of every module of the package `verbs`."""
    verbs = [module.VERB for module in within("fpirhc.cli.verbs")]
    return {verb.name: verb for verb in sorted(verbs, key=lambda verb: verb.name)}


def known() -> dict[str, Known]:
    """Return all commands by name; those of other packages are loaded at their first use and replace none of this package."""
    verbs = {
        verb.name: Known(verb.name, verb.summary, verb.group, partial(_itself, verb)) for verb in shipped().values()
    }
    for point in entry_points(group=GROUP):
        if point.name in verbs:
            print(f"fpirhc: '{_origin(point)}' adds a command '{point.name}', which exists: ignored", file=sys.stderr)
            continue
        verbs[point.name] = Known(point.name, f"(of the package {_origin(point)})", "tools", partial(_loaded, point))
    return verbs


def former_names() -> dict[str, str]:
    """Return the present name of every command by its earlier names."""
    return {old: verb.name for verb in shipped().values() for old in verb.former}


def _itself(verb: Verb) -> Verb:
    return verb


def _loaded(point: EntryPoint) -> Verb:
    from fpirhc.errors import NotSupported

    try:
        verb = point.load()
    except Exception as error:  # a package of somebody else may raise anything while it is imported
        raise NotSupported(
            f"the command '{point.name}' of the package {_origin(point)} cannot be imported "
            f"({type(error).__name__}: {error}); repair that package or remove it"
        ) from error
    if not isinstance(verb, Verb):
        raise NotSupported(
            f"the command '{point.name}' of the package {_origin(point)} is a {type(verb).__name__}: "
            f"its entry point {GROUP} must name a value of fpirhc.cli.verb.Verb"
        )
    return verb


def _origin(point: EntryPoint) -> str:
    return point.dist.name if point.dist else point.value
