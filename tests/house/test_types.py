"""Values of a step are CasADi's own types, and values of the library are frozen."""

import importlib
import inspect
import pkgutil
from dataclasses import is_dataclass

import casadi as ca
import pytest

import fpirhc
from fpirhc.contracts import Block, Layout, scalar
from fpirhc.symbolic.expression import Signals, column, kind
from fpirhc.symbolic.layout import Expression


def test_an_unknown_signal_of_a_step_names_the_nearest_one() -> None:
    block = Block("b", Layout((scalar("desired"),)), Layout((scalar("out"),)), lambda s: {"out": s.desird})
    with pytest.raises(AttributeError, match=r"'desird'.*Did you mean 'desired'"):
        _ = block.function


def test_signals_are_what_they_were_made_of() -> None:
    x = ca.SX.sym("x")
    assert Signals({"x": x}).x is x
    assert vars(Signals({"x": x})) == {"x": x}


@pytest.mark.parametrize(("opaque", "expected"), [(False, ca.SX), (True, ca.MX)])
def test_an_opaque_step_is_built_of_calls(opaque: bool, expected: type[Expression]) -> None:
    assert kind(opaque) is expected
    kinds = []

    def step(s: Signals) -> dict[str, Expression]:
        kinds.append(type(s.x))
        return {"y": s.x}

    _ = Block("b", Layout((scalar("x"),)), Layout((scalar("y"),)), step, opaque=opaque).function
    assert kinds == [expected]


def test_an_empty_column_mixes_with_every_kind() -> None:
    assert isinstance(ca.vertcat(column([]), ca.SX.sym("x")), ca.SX)
    graphs: list[ca.MX] = []
    both = ca.vertcat(column(graphs), ca.MX.sym("x"))
    assert isinstance(both, ca.MX)
    assert both.shape == (1, 1)


WRITERS = "adapters", "export", "problem_files", "symbolic"  # packages whose dataclasses may collect something


def test_values_are_frozen():
    """What is a key of a cache, or is shared by loops, must not change under them."""
    modules = [m.name for m in pkgutil.walk_packages(fpirhc.__path__, "fpirhc.") if not m.name.endswith("__main__")]
    values = {
        f"{module}.{value.__name__}": value
        for module in modules
        if module.split(".")[1] not in WRITERS
        for value in vars(importlib.import_module(module)).values()
        if inspect.isclass(value) and value.__module__ == module and is_dataclass(value)
    }
    assert len(values) > 250
    assert [name for name, value in values.items() if not getattr(value, "__dataclass_params__").frozen] == []  # noqa: B009
