"""Members of families, found by looking into the packages: an addition is one new file.

A family is a contract (a class such as `Deformation`) and a package. Its members are the modules below that package, and
the modules of other distributions that name themselves in the entry-point group `fpirhc.members`. A member's module

- defines one or more concrete classes of the contract, and
- carries `EXAMPLES`, values of these classes that the conformance laws use; a module whose members wrap another value has a
  function `examples(inner)` instead, which returns values around any inner one.

A controller or an estimator that needs a problem of its own is given as an `Example`.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from types import ModuleType
from typing import Any

GROUP = "fpirhc.members"  # entry points of other distributions; each names a module or a package


@dataclass(frozen=True, eq=False)
class Family:
    """A contract and where its members live.

    Parameters:
        contract: "module:Class" of the contract. packages: packages that are searched, with all that is below them.
    """

    contract: str
    packages: tuple[str, ...]

    @property
    def type(self) -> type:
        """The contract's class."""
        module, _, name = self.contract.partition(":")
        found: type = getattr(importlib.import_module(module), name)
        return found


FAMILIES: Mapping[str, Family] = {
    "deformations": Family("fpirhc.deformation.base:Deformation", ("fpirhc.deformation",)),
    "tracking laws": Family("fpirhc.tracking.base:Tracking", ("fpirhc.tracking",)),
    "derivative estimators": Family("fpirhc.sensing.base:DerivativeEstimator", ("fpirhc.sensing",)),
    "optimisers": Family("fpirhc.optimisers.base:Optimiser", ("fpirhc.optimisers",)),
    "controllers": Family("fpirhc.controllers.base:Controller", ("fpirhc.controllers",)),
    "estimators": Family("fpirhc.learning.estimators.base:Estimator", ("fpirhc.learning.estimators",)),
    "adaptation rules": Family("fpirhc.learning.rules.base:Rule", ("fpirhc.learning.rules",)),
}


@dataclass(frozen=True, eq=False)
class Example:
    """A value with the problem that it is tried on.

    Parameters:
        value: the member; None: the controller of that name in the shipped problem.
        problem: name of a shipped problem; empty: the problem of the family's laws. controller: a name in that problem.
        changes: fields of the problem that are replaced. left: share of the error that the laws let it leave (None: theirs).
    """

    value: Any = None
    problem: str = ""
    controller: str = ""
    changes: Mapping[str, Any] = field(default_factory=dict)
    left: float | None = None


def modules(*packages: str) -> Iterator[ModuleType]:
    """Every module below the packages, and every module that another distribution names in the entry-point group."""
    others = tuple(entry.value for entry in entry_points(group=GROUP))
    for name in (*packages, *others):
        root = importlib.import_module(name)
        yield root
        for info in pkgutil.walk_packages(getattr(root, "__path__", ()), f"{name}."):
            yield importlib.import_module(info.name)


def classes_of(module: ModuleType, contract: type) -> tuple[type, ...]:
    """Concrete public classes of a contract that the module itself defines."""
    return tuple(
        member
        for name, member in inspect.getmembers(module, inspect.isclass)
        if issubclass(member, contract)
        and member.__module__ == module.__name__
        and not inspect.isabstract(member)
        and not name.startswith("_")
    )


def member_modules(family: str) -> tuple[ModuleType, ...]:
    """Modules that define a member of the family, in order of their names."""
    kind = FAMILIES[family]
    defining = {m.__name__: m for m in modules(*kind.packages) if classes_of(m, kind.type)}
    return tuple(defining[name] for name in sorted(defining))


def member_classes(family: str) -> tuple[type, ...]:
    """Concrete classes of the family."""
    return tuple(c for m in member_modules(family) for c in classes_of(m, FAMILIES[family].type))


def examples(family: str, inner: Any = None) -> tuple[Any, ...]:
    """Example values of every member of the family; `inner` is what those that wrap another value are given.

    Without `inner`, members that wrap another value are left out.
    """
    values: list[Any] = []
    for module in member_modules(family):
        values += getattr(module, "EXAMPLES", ())
        if inner is not None and hasattr(module, "examples"):
            values += module.examples(inner)
    return tuple(values)


def public_member(name: str) -> Any:
    """The member of that name from the module whose file is named like it (`FooBar` in `foo_bar.py`); None if there is none."""
    for kind in FAMILIES.values():
        for package in kind.packages:
            root = importlib.import_module(package)
            for info in pkgutil.walk_packages(root.__path__, f"{package}."):
                if info.name.rpartition(".")[2].replace("_", "") == name.lower():
                    return getattr(importlib.import_module(info.name), name, None)
    offered = (getattr(importlib.import_module(e.value), name, None) for e in entry_points(group=GROUP))
    return next((value for value in offered if value is not None), None)
