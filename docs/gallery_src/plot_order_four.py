"""
Relative order four: how far a gain may go
==========================================

A force acts on the fourth derivative of a position; the model is three times too heavy
and twice too fast. Whatever the model is asked for, the plant answers three times as
strongly, so an iteration of gain a multiplies its error by 1 - 3 a in every cycle.
"""

import textwrap
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import fpirhc as fp

task = fp.load_problem("order_four")
problem, controllers = task.problem, task.controllers


def rms(problem, controller):
    """Rms error from 10 s on, mm."""
    run = fp.simulate(problem, controller, seed=0)
    return 1e3 * fp.measure(problem, run).rms_error["q"]


names = ("CTC", "CTC+FPI", "RHC", "RHC+FPI, model-referenced", "RHC+FPI")
for name in (*names, "RHC offset-free"):
    print(f"{name:25s} {rms(problem, controllers[name]):.3g} mm")

# %%
# The limit is a = 2/3. Eq. (3) with K_c = 1e6 reaches it with A_c = 6.7e-7. Below it
# the response error falls in the first cycles, beyond it it doubles until the limits
# of the force hold it.

figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
for gain in (3e-7, 5e-7, 6.4e-7, 1e-6):
    law = fp.ComputedTorque(
        fp.Exponential(rate=3.0),
        fp.BeyondLimit(fp.RFPT(offset=1e6, sign=-1.0, gain=gain)),
    )
    run = fp.simulate(replace(problem, duration=0.1, measure_from=0.0), law, seed=0)
    error = np.abs(run["realised.q"][1:] - run["desired.q"][:-1])
    axis.semilogy(np.arange(1, error.size + 1), error + 1e-6, lw=1, label=f"{gain:g}")
axis.set(xlabel="control cycle", ylabel="response error [m/s⁴]")
axis.legend(title="A_c [s⁴/m]")

# %%
# An offset-free plan whose filter finds the disturbance in one cycle is an iteration
# of unit gain: it is beyond the limit too, and diverges. The tuned one is slower.

fast = fp.DisturbanceKalman(
    drift={"q": 1e3}, measured={"q": 1e-6, "q'": 1e-5, "q''": 1e-4, "q'''": 1e-3}
)
plain = controllers["RHC"]
print(f"fast filter: {rms(problem, fp.Estimating(plain, fast)):.0f} mm")

# %%
# All this needs four derivatives. With positions and a noise of a thousandth of a
# millimetre they must be fitted, the response comes 25 cycles late, and the gain is
# refused. Told of the delay, with a tenth of the gain, adaptation is worse than none.

noisy = replace(
    problem,
    sensing=fp.Sensing(
        {"q": fp.Sensor(noise=fp.Noise(1e-6))}, fp.SavitzkyGolay(window=51, degree=4)
    ),
)
try:
    rms(noisy, controllers["CTC+FPI"])
except fp.FpirhcError as reason:
    print(textwrap.fill(str(reason), 85))
leaky = fp.ComputedTorque(
    fp.Exponential(rate=3.0),
    fp.Increment(
        fp.RFPT(offset=1e6, sign=-1.0, gain=5e-8), cycles=noisy.response_delay
    ),
)
print(
    f"CTC {rms(noisy, controllers['CTC']):.0f} mm, with FPI {rms(noisy, leaky):.0f} mm"
)
