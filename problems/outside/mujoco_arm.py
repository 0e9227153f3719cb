"""An arm that MuJoCo moves, with friction, rotor inertia and a tool that nobody weighed, behind the model of two bare rods.

The body has an armature of 0.03 kg m^2, damping 0.2 N m s, dry friction of 0.4 N m in both joints and a tool of 1 kg
(MuJoCo, Apache 2.0); the model is the rigid textbook arm of two uniform rods.

    rms error, seed 0      shoulder [rad]      elbow [rad]
    RHC                            0.0067           0.0055
    RHC+FPI                       4.3e-05          6.0e-05
    RHC+FPI, plain form           0.00022          0.00027
    RHC offset-free               2.8e-05          4.0e-05
    CTC                             0.050             0.28
"""

import casadi as ca

import fpirhc as fp
from fpirhc.adapters.mujoco import mujoco_body

needs = ("mujoco",)
PERIOD = 2e-3  # s
BODY = """<mujoco><option timestep="0.0005" integrator="implicitfast" gravity="0 0 -9.81"/><default>
<joint armature="0.03" damping="0.2" frictionloss="0.4"/><geom type="capsule" size="0.03" contype="0" conaffinity="0"/>
</default><worldbody><body><joint name="shoulder" axis="0 -1 0"/><geom fromto="0 0 0 0.5 0 0" mass="2.0"/>
<body pos="0.5 0 0"><joint name="elbow" axis="0 -1 0"/><geom fromto="0 0 0 0.4 0 0" mass="1.2"/>
<geom type="sphere" pos="0.4 0 0" size="0.05" mass="1.0"/></body></body></worldbody><actuator>
<motor name="M1" joint="shoulder" ctrlrange="-80 80"/><motor name="M2" joint="elbow" ctrlrange="-40 40"/></actuator></mujoco>"""


def rods(q, v, u, p):
    l1, l2, g, bent = 0.5, 0.4, 9.81, q.shoulder + q.elbow
    a, b, c = p.m1 * l1**2 / 3 + p.m2 * l1**2 + p.m2 * l2**2 / 3, p.m2 * l1 * l2 / 2, p.m2 * l2**2 / 3
    inertia = ca.blockcat([[a + 2 * b * ca.cos(q.elbow), c + b * ca.cos(q.elbow)], [c + b * ca.cos(q.elbow), c]])
    turning = b * ca.sin(q.elbow) * ca.vertcat(-(2 * v.shoulder * v.elbow + v.elbow**2), v.shoulder**2)
    outer = p.m2 * g * l2 / 2 * ca.cos(bent)
    weight = ca.vertcat((p.m1 / 2 + p.m2) * g * l1 * ca.cos(q.shoulder) + outer, outer)
    acceleration = ca.solve(inertia, ca.vertcat(u.M1, u.M2) - turning - weight)
    return {"shoulder": acceleration[0], "elbow": acceleration[1]}


plant = fp.Plant(
    coordinates={"shoulder": "rad", "elbow": "rad"},
    inputs={"M1": "N m", "M2": "N m"},
    parameters={"m1": fp.Parameter(2.0, 2.0, "kg"), "m2": fp.Parameter(1.2, 1.2, "kg")},
    response=rods,
)
rest, weights = dict.fromkeys(plant.coordinates, 0.0), {"shoulder": 1e3, "elbow": 1e3, "shoulder'": 1.0, "elbow'": 1.0}
problem = fp.Problem(
    plant=plant,
    reality=mujoco_body(BODY, plant, period=PERIOD),
    reference=fp.Trajectory(lambda t: {"shoulder": 0.8 * (1 - ca.cos(2 * t)), "elbow": -0.5 * (1 - ca.cos(3 * t))}),
    start=rest,
    period=PERIOD,
    duration=5.0,
    measure_from=1.0,  # s
    limits=fp.Limits(inputs={"M1": (-80.0, 80.0), "M2": (-40.0, 40.0)}),
    horizon=fp.Horizon(stages=12, step=PERIOD, lengths=tuple(1.2**k for k in range(12))),
    cost=fp.Quadratic(states=weights, deviation={"M1": 1e-3, "M2": 1e-3}),
)
plain = fp.RecedingHorizon(optimiser := fp.FixedPointSolver())
seen = {f"{joint}{dash}": size for joint in rest for dash, size in {"": 0.01, "'": 0.01, "''": 0.1}.items()}
filter = fp.DisturbanceKalman(drift=dict.fromkeys(rest, 100.0), measured=seen)
controllers = {
    "RHC": plain,
    "RHC+FPI": fp.RecedingHorizon(optimiser, fp.ModelReferenced(fp.Affine(gain=-1.0))),
    "RHC+FPI, plain form": fp.RecedingHorizon(optimiser, fp.Affine(gain=-0.3)),
    "RHC offset-free": fp.Estimating(plain, filter, at_once=True),
    "CTC": fp.ComputedTorque(fp.Exponential(rate=8.0)),
}
headline = ("RHC", "RHC+FPI")
why = "Friction and tool are torques at driven joints, measured exactly: a quick filter has unit gain, and its plan knows of them."
