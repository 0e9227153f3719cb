"""Memory of the iteration with limits."""

from __future__ import annotations

from fpirhc.horizon.problem import OptimalControl
from fpirhc.optimisers.scales import scales
from fpirhc.symbolic.layout import Layout, Signal, scalar


def limited_memory(ocp: OptimalControl) -> Layout:
    """Return the layout of the plan, its states and costates s_1 ... s_N, its feedback, its multipliers, mu and the damping.

    `plan_barrier` is zero where no plan is remembered.
    """
    n, states, inputs = range(ocp.stages), ocp.state.elements, ocp.input.elements
    rows = (*inputs, *(states[k] for k in scales(ocp).bounded))
    later = tuple(f"{e}@{k + 1}" for k in n for e in states)
    multipliers = tuple(f"{side} {e}@{k}" for side in ("lower", "upper") for k in n for e in rows)
    return Layout(
        (
            Signal("plan_inputs", tuple(f"{e}@{k}" for k in n for e in inputs)),
            Signal("plan_states", later),
            Signal("plan_costates", later),
            Signal("plan_gains", tuple(f"{e}/{x}@{k}" for k in n for x in states for e in inputs)),
            Signal("plan_multipliers", multipliers),
            scalar("plan_barrier"),
            scalar("plan_damping"),
        )
    )
