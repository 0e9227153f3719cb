"""The text of a problem file that several tests write: a mass on a line, y'' = b u - k y, with a wrong gain."""

_PLANT = '''"""A mass on a line with a wrong gain."""
import casadi as ca
import fpirhc as fp

plant = fp.Plant(
    coordinates={"y": "m"},
    inputs={"u": "N"},
    parameters={
        "b": fp.Parameter(approximate=1.0, exact=1.6, unit="1/kg"BOUNDS),
        "k": fp.Parameter(2.0, 5.0, "1/s^2"),
    },
    response=lambda q, v, u, p: {"y": p.b * u.u - p.k * q.y},
)
'''
_TASK = """problem = fp.Problem(
    plant=plant,
    reference=fp.Trajectory(lambda t: {"y": ca.sin(2 * t)}),
    start={"y": 0.5},
    TASK,
)
tracking = fp.Exponential(rate=6.0)
"""
_CONTROLLERS = """controllers = {
    "CTC": fp.ComputedTorque(tracking),
    "CTC+FPI": fp.ComputedTorque(tracking, MAP),
}
"""
EXACT = 'controllers["CTC exact"] = fp.ExactModel(controllers["CTC"])\n'


def line_text(task: str, deformation: str = "fp.Sigmoid(gain=-0.5)", *, bounds: str = "", more: str = "") -> str:
    """Return the text of a problem file with the controllers CTC and CTC+FPI."""
    plant = _PLANT.replace("BOUNDS", f", bounds={bounds}" if bounds else "")
    return plant + _TASK.replace("TASK", task) + _CONTROLLERS.replace("MAP", deformation) + more
