"""Pairs of controllers that differ in their adaptation alone."""

from __future__ import annotations

from collections.abc import Mapping

from fpirhc.controllers.base import Controller
from fpirhc.controllers.contract import without_deformation
from fpirhc.describe import describe, identity
from fpirhc.errors import NotSupported


def pair_of(controllers: Mapping[str, Controller], name: str) -> str | None:
    """Return the controller with the same settings and no adaptation; None without one."""
    try:
        wanted = without_deformation(controllers[name])
    except NotSupported:
        return None
    return same_as(wanted, {n: c for n, c in controllers.items() if not c.deformation.adapts})


def same_as(wanted: Controller, controllers: Mapping[str, Controller]) -> str | None:
    """Return the controller with these settings; where several have them, the one whose formulas are the same too."""
    for said in (identity, describe):
        for name, one in controllers.items():
            if said(one) == said(wanted):
                return name
    return None


def not_a_pair(controllers: Mapping[str, Controller], headline: tuple[str, str]) -> str:
    """Return what a headline that is no pair should be; nothing where it is one."""
    pairs = [(plain, n) for n, c in controllers.items() if c.deformation.adapts and (plain := pair_of(controllers, n))]
    if headline in pairs:
        return ""
    near = sorted(pairs, key=lambda pair: -len({*pair} & {*headline}))[:1]
    mend = f"write {near[0]}" if near else "no controller is here with and without adaptation, so leave headline out"
    return f"headline {headline} is no pair: expected a controller and the same one with adaptation; {mend}"
