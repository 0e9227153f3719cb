"""
A filter that starts wrong, and a window that does not mind
===========================================================

In a closed vessel a gas reacts, 2A -> B, and a gauge shows the sum of both pressures.
The batch starts with 3 bar of A and 1 bar of B; it is believed to be 0.1 and 4.5 bar.
Haseltine and Rawlings (Ind. Eng. Chem. Res. 44(8), 2005) show with it where an extended
Kalman filter fails.
"""

import casadi as ca
import matplotlib.pyplot as plt

import fpirhc as fp

gas = fp.Plant.of_states(
    states={"A": "bar", "B": "bar"},
    inputs={"feed": "bar/s"},
    parameters={"k": fp.Parameter(approximate=0.16, exact=0.16, unit="1/bar/s")},
    rates=lambda x, u, p: {"A": -2 * p.k * x.A**2, "B": p.k * x.A**2 + u.feed},
    outputs={"P": fp.Output("bar", lambda x, p: x.A + x.B)},
)


def batch(observer):
    """The batch with its valve shut; the pressure is measured with a noise of 0.1 bar."""
    gauge = {"P": fp.Sensor(noise=fp.Noise(0.1))}
    return fp.Problem(
        plant=gas,
        reality=fp.Reality(gas, start={"A": 3.0, "B": 1.0}),
        start={"A": 0.1, "B": 4.5},  # where the observer begins
        reference=fp.Trajectory(lambda t: {"P": 2.5 + 1.5 * ca.exp(-t)}),
        limits=fp.Limits(inputs={"feed": (0.0, 1e-9)}),
        period=0.1,
        duration=10.0,
        sensing=fp.Sensing(
            gauge, fp.PositionDifference(), measured=["P"], observer=observer
        ),
    )


# %%
# All three know the same: how noisy the gauge is, how far the start may be wrong, and
# that the model is nearly right. The windows hold the last 0.5 s.

known = {
    "measured": {"P": 0.1},
    "noise": {"A": 0.01, "B": 0.01},
    "start": {"A": 6.0, "B": 6.0},
}
positive = {"A": (0.0, float("inf")), "B": (0.0, float("inf"))}
observers = {
    "extended Kalman filter": fp.KalmanFilter(**known),
    "window without bounds": fp.MovingHorizonStates(**known, window=5),
    "window, pressures above zero": fp.MovingHorizonStates(
        **known, window=5, bounds=positive
    ),
}
controller = fp.ComputedTorque(fp.Exponential(rate=1.0))
runs = {
    name: fp.simulate(batch(b), controller, seed=0) for name, b in observers.items()
}

# %%
# Two pressures of A explain why the sum falls: the true one and one below zero, for the
# rate goes with the square of A. A filter that was once behind zero stays there, with a
# sum that is 0.2 bar too low, and so does a window. Bounds keep the window where the
# true pressure can be found.

figure, (top, bottom) = plt.subplots(
    2, 1, figsize=(8, 6), layout="constrained", sharex=True
)
some = next(iter(runs.values()))
top.plot(some.time, some["plant_state.A"], "k", label="true")
bottom.plot(some.time, some["measured.P"], "k.", markersize=3, label="gauge")
for name, run in runs.items():
    top.plot(run.time, run["state.A"], label=name)
    bottom.plot(run.time, run["state"].sum(axis=1), label=name)
    print(f"{name:30s} A after 10 s: {run['state.A'][-1]:5.2f} bar")
top.set_ylabel("A [bar]")
bottom.set_ylabel("A + B [bar]")
bottom.set_xlabel("time [s]")
top.legend()
plt.show()
