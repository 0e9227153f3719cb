"""Problem files as a user would write them, on plants that are not shipped; `fpirhc compare` takes each of them.

cstr             do-mpc's reactor, exact model; variant `wrong`
quadruple_tank   Johansson's four tanks, minimum phase; variant `nonminimum`
drug_infusion    propofol with compartments that have no reference, the wrong kinetics as model
own_map          a user's own deformation and a dead time; controller `unpaired`
"""

import importlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import fpirhc as fp

FOLDER = Path(__file__).parent


def load(name: str, variant: str = "problem") -> Any:
    """The task of one file, with another of the file's problems if `variant` names it."""
    task = fp.load_problem(str(FOLDER / f"{name}.py"))
    return replace(task, problem=getattr(importlib.import_module(f"{__name__}.{name}"), variant))
