"""Members of families, found by a search of the packages: an addition is one new file.

A family is a contract and a package; modules of other distributions are in the entry-point group `fpirhc.members`. A member's
module defines concrete classes of the contract, and has `EXAMPLES`, values that the conformance laws use, or, where its members
wrap another value, `examples(inner)`. What needs a problem of its own stands there as an `Example`.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from types import ModuleType
from typing import Any

GROUP = "fpirhc.members"  # entry points of other distributions; each names a module or a package


@dataclass(frozen=True, eq=False)
class Family:
    """A contract and the packages of its members."""

    contract: str  # "module:Class" of the contract
    packages: tuple[str, ...]  # names of the packages that are searched, with everything below them

    @property
    def type(self) -> type:
        """The contract's class."""
        module, _, name = self.contract.partition(":")
        contract: type = getattr(importlib.import_module(module), name)
        return contract


FAMILIES: Mapping[str, Family] = {
    "deformations": Family("fpirhc.deformation.base:Deformation", ("fpirhc.deformation",)),
    "tracking laws": Family("fpirhc.tracking.base:Tracking", ("fpirhc.tracking",)),
    "derivative estimators": Family("fpirhc.sensing.base:DerivativeEstimator", ("fpirhc.sensing",)),
    "observers": Family("fpirhc.sensing.base:StateObserver", ("fpirhc.sensing",)),
    "optimisers": Family("fpirhc.optimisers:Optimiser", ("fpirhc.optimisers",)),
    "controllers": Family("fpirhc.controllers.base:Controller", ("fpirhc.controllers",)),
    "estimators": Family("fpirhc.learning.estimators:ParameterEstimator", ("fpirhc.learning",)),
    "adaptation rules": Family("fpirhc.learning.rules:Rule", ("fpirhc.learning",)),
}


@dataclass(frozen=True, eq=False)
class Example:
    """A value with the problem on which the laws try it.

    Args:
        value: the member; None: the controller called `controller` in the shipped problem.
        problem: name of a shipped problem; empty: the problem of the family's laws.
        controller: name of a controller in that problem.
        changes: fields of the problem that are replaced.
        left: largest share of the error that may remain; None: the bound of the laws.
    """

    value: Any = None
    problem: str = ""
    controller: str = ""
    changes: Mapping[str, Any] = field(default_factory=dict)
    left: float | None = None


def within(package: str) -> Iterator[ModuleType]:
    """Every module of a package, in order of their names."""
    for info in pkgutil.iter_modules(importlib.import_module(package).__path__, f"{package}."):
        yield importlib.import_module(info.name)


def modules(*packages: str) -> Iterator[ModuleType]:
    """Every module below the packages, and every module that another distribution names in the entry-point group."""
    foreign = tuple(entry.value for entry in entry_points(group=GROUP))
    for name in (*packages, *foreign):
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
    """Example values of every member of the family.

    `inner`: the value that wrappers are built around; None leaves wrappers out.
    """
    values: list[Any] = []
    for module in member_modules(family):
        values += getattr(module, "EXAMPLES", ())
        if inner is not None and hasattr(module, "examples"):
            values += module.examples(inner)
    return tuple(values)


def public_member(name: str) -> Any:
    """The member `FooBar` of the module `foo_bar`, or of a module of another distribution; None if there is none."""
    own = [package for kind in FAMILIES.values() for package in kind.packages]
    for package in own:
        root = importlib.import_module(package)
        member = _in_module_of_its_name(root, name) or _in_package(root, name)
        if member is not None:
            return member
    for point in entry_points(group=GROUP):
        root = importlib.import_module(point.value)
        member = getattr(root, name, None) or _in_module_of_its_name(root, name)
        if member is not None:
            return member
    return None


def adapter_module(name: str) -> str:
    """The module of the adapter that defines the name, such as `as_env`; empty where none does."""
    homes = (one.__name__ for one in within("fpirhc.adapters"))
    return next((home for home in homes if getattr(vars(sys.modules[home]).get(name), "__module__", "") == home), "")


def _in_package(root: ModuleType, name: str) -> Any:
    """The value that a package below another one has in its list of public names; None if there is none."""
    for info in pkgutil.iter_modules(getattr(root, "__path__", ()), f"{root.__name__}."):
        package = importlib.import_module(info.name) if info.ispkg else None
        if name in getattr(package, "__all__", ()):
            return getattr(package, name)
    return None


def _in_module_of_its_name(root: ModuleType, name: str) -> Any:
    """The value `FooBar` of a module `foo_bar` below a package; None if there is none."""
    for info in pkgutil.walk_packages(getattr(root, "__path__", ()), f"{root.__name__}."):
        if info.name.rpartition(".")[2].replace("_", "") == name.lower():
            return getattr(importlib.import_module(info.name), name, None)
    return None
