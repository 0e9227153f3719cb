"""Problem files with one to three random mistakes of the kinds that people make, from a seed, and what these raise inside."""

from __future__ import annotations

import ast
import copy
import random
import traceback
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import fpirhc as fp
from fpirhc.contracts import build
from fpirhc.errors import ProblemFileError

SOURCE = '''"""A cart with everything that a problem file can have."""
import casadi as ca
import fpirhc as fp


def response(q, v, u, p):
    return {"y": (u.force - p.friction * v.y) / p.mass, "z": u.lift / p.mass - 9.81}


plant = fp.Plant(
    coordinates={"y": "m", "z": "m"},
    inputs={"force": "N", "lift": "N"},
    parameters={
        "mass": fp.Parameter(approximate=1.4, exact=1.0, unit="kg", bounds=(0.1, 5.0)),
        "friction": fp.Parameter(approximate=0.0, exact=0.2, unit="N s/m"),
    },
    response=response,
    order=2,
)
problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"y": ca.sin(t), "z": 0.1 * ca.cos(t)}),
    start={"y": 0.1, "z": 0.0},
    period=1e-2, duration=0.1,
    limits=fp.Limits(
        inputs={"force": (-20.0, 20.0)}, states={"y": (-2.0, 2.0)},
        paths={"sum": fp.PathConstraint(lambda view: view.state.y + view.state.z, upper=3.0, unit="m")},
    ),
    disturbances={"force": fp.Formula(lambda t: 0.1 * ca.sin(6.28 * t)), "y": fp.Formula(lambda t: ca.tanh(t))},
    dead_time=fp.DeadTime(inputs={"force": 0.01}),
    sensing=fp.Sensing(sensors={"y": fp.Sensor(noise=fp.Noise(deviation=1e-4))}),
    horizon=fp.Horizon(stages=4, step=1e-2),
    cost=fp.Quadratic(states={"y": 10.0, "z": 10.0, "y'": 0.1}, deviation={"force": 1e-3, "lift": 1e-3}),
    measure_from=0.02, judged=("y", "z"),
)
tracking, optimiser = fp.Exponential(rate=6.0), fp.FixedPointSolver(iterations=1, tolerance=1e-2)
controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+FPI": fp.ComputedTorque(tracking, fp.Paired(fp.Sigmoid(gain=-0.2, scale=10.0), cycles=1)),
    "RHC": fp.RecedingHorizon(optimiser),
    "RHC+FPI": fp.RecedingHorizon(optimiser, fp.Filtered(fp.Affine(gain=-0.3), pole=0.2), tracking=tracking),
    "late": fp.Predicted(fp.ComputedTorque(tracking), inputs=0.01),
    "PID": fp.PID(proportional={"y": 9.0, "z": 9.0}, derivative={"y": (5.0,), "z": (5.0,)}),
}
headline = ("CTC", "CTC+FPI")
'''
WRONG = (
    "None", "True", "'text'", "''", "-1", "0", "0.5", "1e300", "1e-300", "-2.5", "10**9", "float('nan')", "float('inf')",
    "[]", "()", "{}", "[1.0]", "(1.0,)", "{'y': 1.0}", "{'u': 0.3}", "{1: 2}", "lambda: 0", "lambda t: 0.5", "lambda a, b: a",
    "fp.Sigmoid", "fp.Sigmoid(gain=-0.5)", "fp.Exponential", "fp.RecedingHorizon", "fp", "ca.SX.sym('s')", "ca.MX.sym('m')",
    "ca.sin", "object()", "print", "1j", "b'x'", "'ipopt'", "range(3)", "(float('inf'), float('inf'))", "1.0, 2.0",
)  # fmt: skip


def mutated(seed: int) -> str:
    """The source with one to three mistakes."""
    random_numbers = random.Random(seed)
    tree = ast.parse(SOURCE)
    for _ in range(random_numbers.choice((1, 1, 1, 2, 3))):
        random_numbers.choice((_replace, _replace, _replace, _rename, _drop, _swap, _misspell))(tree, random_numbers)
    return ast.unparse(ast.fix_missing_locations(tree))


def raw_error(path: Path, seed: int) -> str:
    """The Python error that a random mistake raises inside the library; empty where it is refused by name, or accepted."""
    path.write_text(mutated(seed), encoding="utf-8")
    try:
        task = fp.load_problem(str(path))
        for controller in task.controllers.values():
            with suppress(fp.FpirhcError):
                build(task.problem, controller)
    except ProblemFileError as refused:
        # An error of the file itself, such as a misspelt name, is shown as Python has it; one from our own lines is not.
        inside = refused.__context__
        wrapped = inside is not None and not isinstance(inside, fp.FpirhcError) and not _from_file(inside, path)
        return f"seed {seed}: {inside!r}" if wrapped else ""
    except Exception as error:  # noqa: BLE001 -- what is looked for
        return f"seed {seed}: {error!r}"
    return ""


def _from_file(error: BaseException, path: Path) -> bool:
    """Whether the innermost line of the file or of the package is the file's."""
    names = [frame.filename for frame in traceback.extract_tb(error.__traceback__)]
    own = [name == str(path) for name in names if name == str(path) or "/fpirhc/" in name]
    return own[-1:] == [True] or isinstance(error, SyntaxError)


def _replace(tree: ast.Module, numbers: random.Random) -> None:
    """Some expression becomes another one."""
    parent, field, place = numbers.choice(list(_expressions(tree)))
    _put(parent, field, place, ast.parse(numbers.choice(WRONG), mode="eval").body)


def _rename(tree: ast.Module, numbers: random.Random) -> None:
    """A keyword, attribute or key is misspelt by one letter."""
    nodes = [n for n in ast.walk(tree) if isinstance(n, ast.keyword | ast.Attribute) or _is_text(n)]
    node = numbers.choice(nodes)
    if isinstance(node, ast.keyword):
        node.arg = _misspelt(node.arg or "x", numbers)
    elif isinstance(node, ast.Attribute):
        node.attr = _misspelt(node.attr, numbers)
    else:
        assert isinstance(node, ast.Constant)
        node.value = _misspelt(str(node.value), numbers)


def _misspell(tree: ast.Module, numbers: random.Random) -> None:
    """A name is misspelt."""
    node = numbers.choice([n for n in ast.walk(tree) if isinstance(n, ast.Name)])
    node.id = _misspelt(node.id, numbers)


def _drop(tree: ast.Module, numbers: random.Random) -> None:
    """An argument, an entry or a definition is left out."""
    lists = [n.keywords for n in ast.walk(tree) if isinstance(n, ast.Call) and n.keywords]
    dicts = [n for n in ast.walk(tree) if isinstance(n, ast.Dict) and n.keys]
    choice = numbers.randrange(len(lists) + len(dicts) + 1)
    if choice < len(lists):
        lists[choice].pop(numbers.randrange(len(lists[choice])))
    elif choice < len(lists) + len(dicts):
        entry = dicts[choice - len(lists)]
        place = numbers.randrange(len(entry.keys))
        entry.keys.pop(place)
        entry.values.pop(place)
    else:
        tree.body.pop(numbers.randrange(1, len(tree.body)))


def _swap(tree: ast.Module, numbers: random.Random) -> None:
    """Two expressions change places."""
    places = list(_expressions(tree))
    first, second = numbers.sample(places, 2)
    one, two = copy.deepcopy(_get(*first)), copy.deepcopy(_get(*second))
    _put(*first, two)
    _put(*second, one)


def _expressions(tree: ast.Module) -> Iterator[tuple[ast.AST, str, int | None]]:
    """Places of expressions that are read: (parent, field, place in a list)."""
    for parent in ast.walk(tree):
        if isinstance(parent, ast.arguments | ast.Import | ast.Attribute):
            continue
        for field, value in ast.iter_fields(parent):
            if isinstance(value, ast.expr) and field not in ("func", "targets"):
                yield parent, field, None
            elif isinstance(value, list) and field not in ("targets", "decorator_list", "body"):
                yield from ((parent, field, k) for k, one in enumerate(value) if isinstance(one, ast.expr))


def _get(parent: ast.AST, field: str, place: int | None) -> ast.expr:
    value = getattr(parent, field)
    one: ast.expr = value if place is None else value[place]
    return one


def _put(parent: ast.AST, field: str, place: int | None, new: ast.expr) -> None:
    if place is None:
        setattr(parent, field, new)
    else:
        getattr(parent, field)[place] = new


def _misspelt(name: str, numbers: random.Random) -> str:
    if not name:
        return "x"
    place = numbers.randrange(len(name))
    return numbers.choice((name[:place] + name[place + 1 :] or "x", name[:place] + "x" + name[place:], name.upper()))


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)
