"""User journeys through the command line, with right and wrong input."""

from __future__ import annotations

import os
import subprocess
import sys

from line import line_text

GOOD = line_text("period=1e-3, duration=2.0, measure_from=1.0")


HORIZON = """measure_from=1.0,
    horizon=fp.Horizon(stages=10, step=1e-2),
    cost=fp.Quadratic(states={"y": 100.0, "y'": 1.0}, deviation={"u": 1e-2}),
    limits=fp.Limits(inputs={"u": (-30.0, 30.0)}),
"""
PLANNERS = """controllers = {
    "RHC": fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3)),
    "RHC+FPI": fp.RecedingHorizon(fp.FixedPoint(iterations=1, tolerance=1e-3), fp.Sigmoid(gain=-0.5, scale=50.0)),
"""


TIGHT = 'limits=fp.Limits(inputs={"u": (-1.0, 1.0)}, states={"y": (0.8, 1.0)})'


def test_linear_algebra_has_one_thread_unless_the_user_says_otherwise():
    """NumPy is imported after the number is set, so a command of its own process is asked."""
    for given, expected in ((None, "1"), ("2", "2")):
        environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
        environment |= {} if given is None else {"OPENBLAS_NUM_THREADS": given}
        code = "import os, sys\nfrom fpirhc.cli.main import main\nassert 'numpy' not in sys.modules\nmain(['list', '--x'])\n"
        asked = [sys.executable, "-c", f"{code}print(os.environ['OPENBLAS_NUM_THREADS'])"]
        done = subprocess.run(asked, env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.strip() == expected
