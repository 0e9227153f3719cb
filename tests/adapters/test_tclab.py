"""The Temperature Control Lab behind two energy balances: its twin, and the board with a clock of the test's own."""

from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.adapters.tclab import RealTime, tclab_body
from fpirhc.errors import InvalidProblem

tclab: Any = pytest.importorskip("tclab", reason="it needs the extra fpirhc[outside]")
PERIOD = 2.0


def constant(value: float, unit: str) -> fp.Parameter:
    return fp.Parameter(approximate=value, exact=value, unit=unit)


# The step test of the course: .9 K/% and 175 s; the second heater has half the power.
LAB = fp.Plant(
    {"T1": "degC", "T2": "degC"},
    {"Q1": "%", "Q2": "%"},
    {"K1": constant(0.9, "K/%"), "K2": constant(0.45, "K/%"), "tau": constant(175.0, "s")},
    lambda q, u, p: {"T1": (p.K1 * u.Q1 - (q.T1 - 21)) / p.tau, "T2": (p.K2 * u.Q2 - (q.T2 - 21)) / p.tau},
    order=1,
)


def problem(reality: fp.ExternalPlant) -> fp.Problem:
    return fp.Problem(
        plant=LAB,
        reality=reality,
        sensing=fp.Sensing(estimator=fp.PositionDifference()),
        reference=fp.Trajectory(
            lambda t: {"T1": 21 + 29 * (1 - ca.exp(-t / 60)), "T2": 21 + 14 / (1 + ca.exp(-(t - 300) / 30))}
        ),
        start={"T1": 21.0, "T2": 21.0},
        period=PERIOD,
        duration=900.0,
        measure_from=100.0,
        limits=fp.Limits(inputs={"Q1": (0.0, 100.0), "Q2": (0.0, 100.0)}),
    )


def test_the_twin_is_the_packages_own_model():
    body: Any = tclab_body(LAB, period=PERIOD).body
    same = tclab.tclab.TCLabModel(synced=False)
    same.tstart = same.tlast = 0.0
    body.reset(0)
    for k in range(50):
        seen = body.step(k * PERIOD, np.array([60.0, 30.0]))
        same.Q1(60.0), same.Q2(30.0)
        same.update((k + 1) * PERIOD)
    assert seen == pytest.approx([same._T1, same._T2], abs=0.6)  # noise and the converter's steps


def test_the_board_is_asked_when_its_cycle_is_over(monkeypatch):
    now = [100.0]

    class Board(tclab.tclab.TCLabModel):  # type: ignore[misc]
        def __init__(self):
            super().__init__(synced=False)
            self.tstart = self.tlast = 0.0
            self.closed = False

        def update(self, t=None):
            del t
            super().update(now[0] - 100.0)

        def close(self):
            self.closed = True

    def sleep(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(tclab, "TCLab", Board)
    body: Any = tclab_body(LAB, period=PERIOD, board=RealTime(lambda: now[0], sleep), rest={"Q1": 0.0, "Q2": 0.0}).body
    body.reset(0)
    body.step(0.0, np.array([50.0, 0.0]))
    now[0] += 0.5  # the controller's own time
    body.step(2.0, np.array([50.0, 0.0]))
    assert now[0] == pytest.approx(104.0)
    now[0] += 5.0
    with pytest.raises(InvalidProblem, match=r"the cycle of 2 s ended 3 s late"):
        body.step(4.0, np.array([50.0, 0.0]))
    first = body._lab
    now[0] = 100.0
    body.reset(0)
    assert first.closed


def test_a_board_says_what_its_heaters_are_sent_at_the_end():
    with pytest.raises(InvalidProblem, match=r'keeps its heaters on after a run; .* rest={"Q1": 0.0, "Q2": 0.0}'):
        tclab_body(LAB, period=PERIOD, board=RealTime())


def test_other_names_are_refused():
    other = fp.Plant({"T3": "degC"}, {"Q": "%"}, {}, lambda q, u, p: {"T3": u.Q}, order=1)
    with pytest.raises(InvalidProblem) as caught:
        tclab_body(other, period=PERIOD)
    assert "measured 'T3' is unknown. Did you mean 'T2'?" in str(caught.value)
    assert "input 'Q' is unknown. Did you mean 'Q2'?" in str(caught.value)
