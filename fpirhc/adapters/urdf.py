"""The equations of an arm from its URDF, as a plant: links by Newton and Euler, torques at the joints, weight along -z.

model = arm("panda.urdf", exact={"hand": 1.6})          the true mass of a link; the model has that of the file
problem = fp.Problem(plant=model, reality=mujoco_body("panda.urdf", model, ...), ...)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import casadi as ca
import numpy as np

from fpirhc.adapters.names import adapter
from fpirhc.errors import InvalidProblem, Mistakes
from fpirhc.plant.plant import Parameter, Plant
from fpirhc.symbolic.layout import Expression, Named

_Number = ca.SX | float
_Values = Named | Mapping[str, Expression] | Mapping[str, float]
_MOVING, _GRAVITY = ("revolute", "continuous", "prismatic"), 9.81  # m/s^2


@adapter
def arm(urdf: str | Path, *, exact: Mapping[str, float] | None = None) -> Plant:
    """Return the plant M(q) q'' + h(q, q') = torques - damping q'.

    Coordinates are the moving joints, rad or m; inputs are JOINT_torque, N m, or JOINT_force, N. Parameters are the masses of the
    links, mass_LINK; the inertia of a link grows with its mass. Limits of joints and their dry friction are not read.

    Args:
        urdf: path of the file, or its text, which begins with "<".
        exact: link -> mass in the simulated plant, kg, where it is not that of the file.

    Raises:
        InvalidProblem: a link that the file does not have, a joint of another type, or no moving joint.

    Source: J. Y. S. Luh, M. W. Walker, R. P. C. Paul, On-line computational scheme for mechanical manipulators, 1980.
    """
    text = str(urdf)
    root = ElementTree.fromstring(text) if text.lstrip().startswith("<") else ElementTree.parse(text).getroot()
    inertial = {one.get("name", ""): part for one in root.iter("link") if (part := one.find("inertial")) is not None}
    masses = {name: mass for name, one in inertial.items() if (mass := _number(one, "mass", "value")) > 0}
    mistakes = Mistakes("arm")
    mistakes.unknown("exact: link", exact or {}, masses)
    joints = _in_order(root, mistakes)
    mistakes.raise_if_any()
    moving = [joint for joint in joints if joint.type in _MOVING]
    if not moving:
        raise InvalidProblem("arm: the file has no joint that moves (revolute, continuous, prismatic)")
    bodies = {name: _Link(*_frame(inertial[name]), _tensor(inertial[name])) for name in masses}
    inputs = {j.name: f"{j.name}_{'force' if j.slides else 'torque'}" for j in moving}

    def torques(q: Named, v: _Values, a: _Values, p: Named, gravity: float) -> ca.SX:
        motion = {j.name: (q[j.name], v[j.name], a[j.name]) for j in moving}
        scale = {name: p[f"mass_{name}"] for name in bodies}
        effort = _newton_euler(joints, bodies, masses, scale, motion, gravity)
        return ca.vertcat(*(effort[j.name] + j.damping * v[j.name] for j in moving))

    def response(q: Named, v: Named, u: Named, p: Named) -> Mapping[str, Expression]:
        still, unit = dict.fromkeys(inputs, 0.0), np.eye(len(moving))
        columns = [torques(q, still, dict(zip(inputs, row, strict=True)), p, 0.0) for row in unit]
        bias = torques(q, v, dict.fromkeys(inputs, 0.0), p, _GRAVITY)
        acceleration = ca.solve(ca.horzcat(*columns), ca.vertcat(*(u[name] for name in inputs.values())) - bias)
        return dict(zip(inputs, ca.vertsplit(acceleration), strict=True))

    def inverse(q: Named, v: Named, r: Named, p: Named) -> Mapping[str, Expression]:
        wanted = torques(q, v, {name: r[name] for name in inputs}, p, _GRAVITY)
        return dict(zip(inputs.values(), ca.vertsplit(wanted), strict=True))

    return Plant(
        coordinates={j.name: "m" if j.slides else "rad" for j in moving},
        inputs={inputs[j.name]: "N" if j.slides else "N m" for j in moving},
        parameters={f"mass_{n}": Parameter(m, (exact or {}).get(n, m), "kg") for n, m in masses.items()},
        response=response,
        inverse=inverse,
    )


@dataclass(frozen=True)
class _Link:
    """Centre of mass and inertia there, in the link's frame."""

    turned: np.ndarray
    centre: np.ndarray
    tensor: np.ndarray

    @property
    def inertia(self) -> np.ndarray:
        return np.asarray(self.turned @ self.tensor @ self.turned.T)


@dataclass(frozen=True)
class _Joint:
    """A joint between two links: where it stands in its parent, and along what it moves."""

    name: str
    type: str
    parent: str
    child: str
    turned: np.ndarray
    place: np.ndarray
    axis: np.ndarray
    damping: float

    @property
    def slides(self) -> bool:
        return self.type == "prismatic"

    def frame(self, angle: _Number) -> tuple[ca.SX, ca.SX]:
        """Rotation from the child to the parent, and the child's origin in the parent."""
        if self.slides:
            return ca.SX(self.turned), ca.SX(self.place) + self.turned @ self.axis * angle
        cross = np.asarray(ca.skew(self.axis))
        turn = np.eye(3) + ca.sin(angle) * cross + (1 - ca.cos(angle)) * (cross @ cross)
        return ca.mtimes(self.turned, turn), ca.SX(self.place)


def _newton_euler(
    joints: list[_Joint],
    bodies: Mapping[str, _Link],
    masses: Mapping[str, float],
    scale: Mapping[str, Expression],
    motion: Mapping[str, tuple[_Number, _Number, _Number]],
    gravity: float,
) -> dict[str, ca.SX]:
    """Forces and torques of the moving joints: motion outwards from the base, forces inwards from the tips."""
    zero = ca.SX.zeros(3)
    bases = {j.parent for j in joints} - {j.child for j in joints}
    state = {base: (zero, zero, ca.SX([0.0, 0.0, gravity])) for base in bases}  # turning, its rate, acceleration
    frames: dict[str, tuple[ca.SX, ca.SX]] = {}
    for j in joints:
        angle, rate, acceleration = motion.get(j.name, (0.0, 0.0, 0.0))
        turn, place = frames[j.name] = j.frame(angle)
        w, dw, a = state[j.parent]
        a = turn.T @ (a + ca.cross(dw, place) + ca.cross(w, ca.cross(w, place)))
        w, dw = turn.T @ w, turn.T @ dw
        if j.slides:
            a = a + j.axis * acceleration + 2 * ca.cross(w, j.axis * rate)
        else:
            dw = dw + j.axis * acceleration + ca.cross(w, j.axis * rate)
            w = w + j.axis * rate
        state[j.child] = w, dw, a
    load = dict.fromkeys(state, (zero, zero))  # force, torque about the frame's origin
    effort: dict[str, ca.SX] = {}
    for j in reversed(joints):
        force, torque = load[j.child]
        if j.child in bodies:
            body, (w, dw, a) = bodies[j.child], state[j.child]
            inertia = body.inertia * (scale[j.child] / masses[j.child])
            own = scale[j.child] * (a + ca.cross(dw, body.centre) + ca.cross(w, ca.cross(w, body.centre)))
            force = force + own
            torque = torque + inertia @ dw + ca.cross(w, inertia @ w) + ca.cross(body.centre, own)
        effort[j.name] = ca.dot(force if j.slides else torque, j.axis)
        turn, place = frames[j.name]
        before_force, before_torque = load[j.parent]
        load[j.parent] = before_force + turn @ force, before_torque + turn @ torque + ca.cross(place, turn @ force)
    return effort


def _in_order(root: ElementTree.Element, mistakes: Mistakes) -> list[_Joint]:
    """The joints, each after that of its parent."""
    joints = {}
    for one in root.iter("joint"):
        parent, child = one.find("parent"), one.find("child")
        if parent is None or child is None:  # such as a joint of a transmission
            continue
        name, kind, axis = one.get("name", ""), one.get("type", ""), one.find("axis")
        if kind not in (*_MOVING, "fixed"):
            mistakes.add(f"joint '{name}' is {kind}; expected {', '.join(_MOVING)} or fixed")
        along = np.array([1.0, 0.0, 0.0]) if axis is None else _triple(axis.get("xyz", "1 0 0"))
        size = float(np.linalg.norm(along)) or 1.0
        ends = parent.get("link", ""), child.get("link", "")
        joints[ends[1]] = _Joint(name, kind, *ends, *_frame(one), along / size, _number(one, "dynamics", "damping"))
    ordered: list[_Joint] = []
    reached = {j.parent for j in joints.values()} - set(joints)
    while len(ordered) < len(joints):
        new = [j for j in joints.values() if j.parent in reached and j.child not in reached]
        if not new:
            raise InvalidProblem("arm: links go round in a circle; expected a tree")
        ordered, reached = [*ordered, *new], reached | {j.child for j in new}
    return ordered


def _frame(element: ElementTree.Element) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and place of an element's origin."""
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    roll, pitch, yaw = _triple(origin.get("rpy", "0 0 0"))
    cos, sin = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    x = np.array([[1, 0, 0], [0, cos[0], -sin[0]], [0, sin[0], cos[0]]])
    y = np.array([[cos[1], 0, sin[1]], [0, 1, 0], [-sin[1], 0, cos[1]]])
    z = np.array([[cos[2], -sin[2], 0], [sin[2], cos[2], 0], [0, 0, 1]])
    return z @ y @ x, _triple(origin.get("xyz", "0 0 0"))


def _tensor(element: ElementTree.Element) -> np.ndarray:
    xx, xy, xz, yy, yz, zz = (_number(element, "inertia", f"i{n}") for n in ("xx", "xy", "xz", "yy", "yz", "zz"))
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _number(element: ElementTree.Element, name: str, attribute: str) -> float:
    child = element.find(name)
    return float(child.get(attribute, "0")) if child is not None else 0.0


def _triple(text: str) -> np.ndarray:
    return np.array([float(number) for number in text.split()])
