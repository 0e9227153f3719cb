"""The equations of an arm from its URDF, as a plant: torques at the joints, weight along -z; Pinocchio reads the file.

model = arm("panda.urdf", exact={"hand": 1.6})          the true mass of a link; the model has that of the file
problem = fp.Problem(plant=model, reality=mujoco_body("panda.urdf", model, ...), ...)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from fpirhc.adapters.names import adapter, from_path_or_text
from fpirhc.errors import Mistakes, package
from fpirhc.plant.plant import Parameter, Plant
from fpirhc.symbolic.layout import Expression, Named


@adapter
def arm(urdf: str | Path, *, exact: Mapping[str, float] | None = None) -> Plant:
    """Return the plant M(q) q'' + h(q, q') = torques - damping q'.

    With T_j(q) the place of joint j as a matrix of 3 x 4 and J_j the pseudo-inertia of what it carries, of 4 x 4,

        M_kl = sum_j tr(dT_j/dq_k J_j dT_j/dq_l^T),        h_k = sum_j tr(dT_j/dq_k J_j (T_j'' at q'' = 0, less gravity)^T)

    Coordinates are the moving joints, rad or m; inputs are JOINT_torque, N m, or JOINT_force, N. Parameters are the masses of the
    links that move, mass_LINK; the inertia of a link grows with its mass. Limits of joints and their dry friction are not read.

    Args:
        urdf: path of the file, or its text, which begins with "<".
        exact: link -> mass in the simulated plant, kg, where it is not that of the file.

    Raises:
        NotSupported: Pinocchio is not installed.
        InvalidProblem: a link that does not move with any joint, a joint of another type, or no moving joint.

    Source: J. J. Uicker, On the dynamic analysis of spatial linkages using 4 by 4 matrices, 1965.
    """
    pinocchio, mistakes = package("pinocchio", "outside"), Mistakes("arm")
    robot = from_path_or_text(urdf, pinocchio.buildModelFromUrdf, pinocchio.buildModelFromXML)
    joints = dict(zip(list(robot.names)[1:], list(robot.joints)[1:], strict=True))  # the first one is the world
    wrong = ", ".join(f"joint '{name}' has {one.nv} degrees of freedom" for name, one in joints.items() if one.nv != 1)
    if wrong or not joints:
        mistakes.add(f"{wrong or 'no joint moves from the base on'}; expected ones that turn, slide or stand")
    links = _links(pinocchio, robot)
    masses = {name: float(inertia[3, 3]) for name, (_, inertia) in links.items()}
    mistakes.unknown("exact: link", exact or {}, masses)
    mistakes.raise_if_any()
    twists = {name: joint.createData().S for name, joint in joints.items()}
    kinds = {n: ("m", "force", "N") if twist[:3].any() else ("rad", "torque", "N m") for n, twist in twists.items()}
    inputs = {f"{name}_{effort}": unit for name, (_, effort, unit) in kinds.items()}

    def efforts(q: Named, v: Named, r: Named, p: Named) -> ca.SX:
        """M q'' + h + damping q'; the places of what carries the links are one column."""
        angles, rates, accelerations = (ca.vertcat(*(one[name] for name in joints)) for one in (q, v, r))
        carriers = _places(robot, twists.values(), ca.vertsplit(angles))
        places = ca.vertcat(*(ca.vec(carriers[joint][:3, :]) for joint, _ in links.values()))
        speed, pull = ca.jtimes(places, angles, rates), np.tile([*np.zeros(11), -9.81], len(links))  # m/s^2
        moved = ca.jtimes(speed, angles, rates) + ca.jtimes(places, angles, accelerations) - pull
        scaled = [inertia * (p[f"mass_{name}"] / masses[name]) for name, (_, inertia) in links.items()]
        forces = ca.diagcat(*(ca.kron(inertia, ca.SX.eye(3)) for inertia in scaled)) @ moved
        return ca.jtimes(places, angles, forces, True) + robot.damping * rates

    def response(q: Named, v: Named, u: Named, p: Named) -> Mapping[str, Expression]:
        wanted, pushed = ca.SX.sym("r", len(joints)), ca.vertcat(*(u[name] for name in inputs))
        inertia, bias = ca.linear_coeff(efforts(q, v, Named(tuple(joints), wanted, "coordinate"), p), wanted)
        return dict(zip(joints, ca.vertsplit(ca.solve(inertia, pushed - bias)), strict=True))

    def inverse(q: Named, v: Named, r: Named, p: Named) -> Mapping[str, Expression]:
        return dict(zip(inputs, ca.vertsplit(efforts(q, v, r, p)), strict=True))

    parameters = {f"mass_{n}": Parameter(m, (exact or {}).get(n, m), "kg") for n, m in masses.items()}
    return Plant({n: unit for n, (unit, _, _) in kinds.items()}, inputs, parameters, response, inverse=inverse)


def _links(pinocchio: Any, robot: Any) -> dict[str, tuple[int, np.ndarray]]:
    """Link with mass -> the joint that carries it, and its pseudo-inertia there; Pinocchio's joints have the sums."""
    own, links = [one.toPseudoInertia().toMatrix() for one in robot.inertias], {}
    for frame in robot.frames:
        holder, joint = robot.frames[frame.parentFrame], frame.parentJoint
        if holder.type == pinocchio.FrameType.FIXED_JOINT:
            links[frame.name] = joint, holder.placement.act(holder.inertia).toPseudoInertia().toMatrix()
            own[joint] -= links[frame.name][1]
        elif frame.type == pinocchio.FrameType.BODY:
            links[frame.name] = joint, own[joint]  # less what follows
    return {name: (joint, inertia) for name, (joint, inertia) in links.items() if joint and inertia[3, 3] > 1e-9}  # kg


def _places(robot: Any, twists: Iterable[np.ndarray], angles: list[ca.SX]) -> list[ca.SX]:
    """Rotation and origin of the base and of every moving joint in the base, of 4 x 4."""
    places = [ca.SX(np.eye(4))]
    for parent, at, twist, angle in zip(robot.parents[1:], robot.jointPlacements[1:], twists, angles, strict=True):
        cross = ca.skew(twist[3:])
        turn = np.eye(3) + ca.sin(angle) * cross + (1 - ca.cos(angle)) * (cross @ cross)
        places.append(places[parent] @ at.homogeneous @ ca.blockcat([[turn, twist[:3] * angle], [np.zeros((1, 3)), 1]]))
    return places
