"""A probe of bodies whose gain, dead time, lag and noise are known."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import casadi as ca
import numpy as np
import pytest
from bodies import PERIOD, RHC, body_problem

import fpirhc as fp
from fpirhc.contracts import Deformation
from fpirhc.probing.choice import Candidate, Choice, Form
from fpirhc.probing.identification import Channel, Estimates, delayed, identify
from fpirhc.probing.probe import OnPlant, Trial, best
from fpirhc.probing.recording import excited, sequence

KNOWN = [  # gain, dead time in cycles, lag in s, noise of the response
    (1.0, 0, 0.0, 0.05),
    (0.4, 0, 0.0, 0.05),
    (2.5, 0, 0.0, 0.05),
    (1.0, 3, 0.0, 0.05),
    (1.6, 7, 0.0, 0.3),
    (0.6, 0, 0.05, 0.05),
    (1.5, 2, 0.03, 0.3),
]


def identified(
    problem: fp.Problem, cycles: int = 300, amplitude: float | None = None, seed: int = 0
) -> tuple[Channel, ...]:
    """What one excited run says of every response."""
    given = None if amplitude is None else {"q": amplitude}
    record = excited(problem, RHC, cycles=cycles, amplitude=given, seed=seed)
    return identify(record.measured, record.modelled, problem.period, record.usable)


# --- Estimates --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gain", "dead", "lag", "noise"), KNOWN)
def test_the_estimates_are_those_of_the_body(gain, dead, lag, noise):
    """The dead time to the cycle; gain, lag and noise within 6, 10 and 10 %; all intervals contain the truth."""
    (one,) = identified(body_problem(gain, dead, lag, noise))
    assert (one.dead_time.low, one.dead_time.value, one.dead_time.high) == (dead, dead, dead)
    assert one.gains[0].value == pytest.approx(gain, rel=0.06)
    assert one.gains[0].low <= gain <= one.gains[0].high
    assert one.lag.value == pytest.approx(lag, rel=0.1, abs=0.3 * PERIOD)
    assert one.lag.low <= lag <= one.lag.high
    assert one.noise == pytest.approx(noise, rel=0.1)


@pytest.mark.parametrize(
    ("body", "stated"),
    [
        ({"dead": 2, "lag": 0.05}, {"body": {"dead_time": {"u": 2 * PERIOD}, "lag": {"u": 0.05}}}),
        ({"lag": 0.05}, {"problem": {"dead_time": fp.DeadTime(inputs={"u": 2 * PERIOD})}}),
        ({"lag": 0.05}, {"problem": {"dead_time": fp.DeadTime(measurement=2 * PERIOD)}}),
    ],
)
def test_lateness_that_is_stated_is_found_as_if_it_were_not(monkeypatch, body, stated):
    """The plant as estimated has all of it: margins on a plant without it would let through what destroys the loop."""
    monkeypatch.setattr(Choice, "shortlist", lambda _: {})
    problem = replace(body_problem(1.0, noise=0.05, **body), duration=2.0)
    assert isinstance(problem.reality, fp.ExternalPlant)
    reality = replace(problem.reality, **stated.get("body", {}))
    found = fp.probe(replace(problem, reality=reality, **stated.get("problem", {})), RHC, cycles=150)
    assert found.dead_time["u"].value == 2
    assert found.lag["u"].low <= 0.05 <= found.lag["u"].high
    assert found.problem is not None
    assert found.problem.dead_time.inputs == {"u": pytest.approx(2 * PERIOD)}
    assert found.problem.dead_time.measurement == 0


def test_an_interval_of_lags_ends_between_searched_ones():
    """A likelihood that is sharper than the grid leaves one of its lags; its interval has a width all the same."""
    random = np.random.default_rng(4)
    modelled = np.repeat(random.standard_normal(75), 4)[:, np.newaxis]
    (one,) = identify(
        1.3 * delayed(modelled, 2, 0.0437, PERIOD) + 1e-4 * random.standard_normal((300, 1)), modelled, PERIOD
    )
    assert one.lag.low < 0.0437 < one.lag.high < 1.2 * one.lag.low
    assert one.gains[0].low < 1.3 < one.gains[0].high


def test_an_end_of_the_lag_has_the_gains_that_go_with_it():
    """A record says the same of a longer lag with a larger gain: a margin is asked of both together."""
    estimates = Estimates(identified(body_problem(0.6, 0, 0.05, 0.05)), 0)
    (best, *_, short, long), (one,) = estimates.ends, estimates.channels
    assert (short.lags[0], best.lags[0], long.lags[0]) == (one.lag.low, one.lag.value, one.lag.high)
    assert short.gains[0, 0] < 0.95 * best.gains[0, 0] < 0.95 * 0.95 * long.gains[0, 0]


def test_a_dead_time_beyond_the_first_search_is_found():
    """The search ends at 10 cycles at first; an estimate at its edge widens it."""
    (one,) = identified(body_problem(1.0, 15, 0.0, 0.1))
    assert (one.dead_time.value, one.edge) == (15, "")


def test_listening_agrees_with_exciting():
    """The jumps of plans excite a little: with amplitude 0 the intervals are wider and contain the truth."""
    problem = body_problem(1.6, 2, 0.0, 0.1)
    (heard,), (excited_,) = (identified(problem, amplitude=a) for a in (0.0, None))
    assert heard.gains[0].low <= 1.6 <= heard.gains[0].high
    assert heard.gains[0].high - heard.gains[0].low > excited_.gains[0].high - excited_.gains[0].low


def test_coupled_bodies_have_a_gain_matrix():
    """Every entry within its interval, of the columns' own inputs."""
    gains = np.array([[0.8, 0.2], [-0.3, 0.7]])
    found = identified(body_problem(gains.tolist(), 1, 0.0, 0.05))
    for row, one in zip(gains, found, strict=True):
        assert one.dead_time.value == 1
        for value, interval in zip(row, one.gains, strict=True):
            assert interval.low <= value <= interval.high
            assert interval.value == pytest.approx(value, abs=0.06)


def test_the_excitation_is_bounded_and_the_channels_independent():
    """+-1, held for 16 cycles at most one after another of one sign twice, uncorrelated, and 0 at its end."""
    signs = sequence(400, 2, seed=1)
    assert set(np.unique(signs[:-1])) == {-1.0, 1.0}
    assert not signs[-1].any()
    assert abs(np.mean(signs[:, 0] * signs[:, 1])) < 0.2


# --- The choice -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("known", [pytest.param(KNOWN[1], marks=pytest.mark.slow), KNOWN[3]])
def test_the_choice_is_near_the_best_of_a_grid_by_hand(known):
    """At most 1.2 times the least error of 16 settings that are given the true gain, dead time and lag."""
    gain, dead, _, _ = known
    problem = replace(body_problem(*known), duration=4.0)
    found = fp.probe(problem, RHC)

    def error(deformation: Deformation | None) -> float:
        assert deformation is not None
        run = fp.simulate(problem, replace(RHC, deformation=deformation), seed=1, compiled=False)
        return np.inf if run.stop else fp.measure(problem, run).rms_error["q"]

    by_hand = [
        error(fp.ModelReferenced(fp.Affine(gain=-2 * g / gain), cycles=float(d)))
        for g in (0.05, 0.15, 0.3, 0.6)
        for d in {0, dead}
    ]
    assert error(found.deformation) <= 1.2 * min(by_hand)
    assert all(one.worst <= 1.03 for name, one in found.trials.items() if found.candidates[name] == found.deformation)


def test_the_plant_as_estimated_predicts_the_body(monkeypatch):
    """The error of the controller alone, and with an adaptation, is that on the body within a tenth."""
    monkeypatch.setattr(Choice, "shortlist", lambda _: {})
    problem = body_problem(1.6, 2, 0.03, 0.1)
    found = fp.probe(problem, RHC, trials=False)
    assert found.trials == {}
    assert found.problem is not None
    real = replace(problem, duration=found.problem.duration, measure_from=found.problem.measure_from)
    for deformation in (fp.Identity(), fp.ModelReferenced(fp.Affine(gain=-0.6), cycles=2.0, lag=0.03, pole=0.5)):
        predicted, true = (
            fp.measure(p, fp.simulate(p, replace(RHC, deformation=deformation), seed=0, compiled=False)).rms_error["q"]
            for p in (found.problem, real)
        )
        assert predicted == pytest.approx(true, rel=0.1)


def test_a_wrong_sign_is_refused():
    """The plant answers against its model: no gain of the map would do, and the reason says what to turn."""
    found = fp.probe(body_problem(-0.5, 0, 0.0, 0.1), RHC, cycles=150)
    assert found.gain["q"]["q"].high < 0
    assert found.deformation is None
    assert found.why.startswith("the sign of the gain is wrong")
    assert found.lines == "deformation=fp.Identity(),"


def test_inputs_that_are_exchanged_are_refused():
    """With the two inputs of a pair exchanged, the gains have an eigenvalue of -1."""
    found = fp.probe(body_problem([[0.0, 1.0], [1.0, 0.0]], 0, 0.0, 0.05), RHC, cycles=150)
    assert found.deformation is None
    assert "wrong sign" in found.why


def test_trials_keep_none_that_is_worse():
    """A gain far beyond the limit is tried, fails, and nothing is kept; nor is one that makes one coordinate worse."""
    problem = replace(body_problem(1.0, 3, 0.0, 0.05), duration=3.0)
    wild = OnPlant(problem, RHC).trial(fp.ModelReferenced(fp.Affine(gain=-1.2)), 1)
    assert isinstance(wild, Trial)
    assert wild.error > 1
    assert best({"wild": wild}) is None
    assert best({"a": Trial(0.5, 1.04), "b": Trial(0.7, 1.0), "c": Trial(0.97, 0.97)}) == "b"
    assert (
        best({"bold": Trial(0.5, 1.0), "prompt, share 0.4": Trial(0.48, 1.0)}) == "bold"
    )  # a tenth is no reason to dare
    assert best({"bold": Trial(0.5, 1.0), "prompt": Trial(0.4, 1.0)}) == "prompt"


def forms(choice: Choice, *names: str) -> dict[str, Candidate]:
    """The first forms of a choice, by other names: a list of candidates without the search."""
    return {name: choice._candidate(form, 0.2) for name, form in zip(names, choice.forms().values(), strict=False)}


def test_a_daring_candidate_that_bears_no_more_gain_is_told_as_such(monkeypatch):
    """It passes, but not with 1.4 times its gain: its trial is shown, and nobody says that the loop refuses it."""
    monkeypatch.setattr(Choice, "shortlist", lambda choice: forms(choice, "prompt"))
    monkeypatch.setattr(OnPlant, "trial", lambda *_, loud=False: Trial(1.5 if loud else 0.5, 1.0))
    found = fp.probe(body_problem(1.0, 0, 0.0, 0.05), RHC, cycles=100)
    assert found.deformation is None
    assert "bore 1.4 times its gain" in found.why
    assert found.trials["prompt"] == Trial(0.5, 1.0, bears=False)
    assert "prompt is not kept: on the plant it does not bear 1.4 times its gain" in found.notes


PROMPT = Form(True, (0.0,), (0.0,))


def candidate(share: float, error: float = 0.1) -> Candidate:
    return Candidate(PROMPT, share, fp.Affine(gain=-share), error, 0.5)


def test_shares_beside_the_best_one_are_tried_whatever_is_predicted_of_them(monkeypatch):
    """The next ones of the list first; then the geometric mean upwards, until two are a twentieth apart."""
    monkeypatch.setattr(Choice, "_accepted", lambda *_: True)
    monkeypatch.setattr(Choice, "_candidate", lambda _, form, share: Candidate(form, share, fp.Identity()))
    choice = Choice.__new__(Choice)

    def beside(share: float, *known: float) -> set[float]:
        return set(choice.beside(candidate(share), [candidate(one) for one in known]))

    assert beside(0.25, 0.25) == {0.16, 0.4}
    assert beside(0.25, 0.16, 0.25, 0.4) == {0.32}
    assert beside(0.25, 0.16, 0.25, 0.32, 0.4) == {0.28}
    assert beside(0.25, 0.16, 0.25, 0.262) == set()
    assert beside(1.0, 0.65, 1.0) == set()


@pytest.mark.parametrize(("error", "kept"), [(0.29, ["bold"]), (0.2, ["bold", "bold, share 0.4"])])
def test_of_shares_that_are_alike_the_smallest_is_kept(monkeypatch, error, kept):
    """With errors that hardly depend on the share every larger one was tried with three seeds and a larger gain."""
    small, large = candidate(0.25), candidate(0.4)
    errors = {small.deformation: 0.295, large.deformation: error}
    monkeypatch.setattr(OnPlant, "trial", lambda _, one, *__, **___: Trial(errors.get(one, error), 0.3))
    monkeypatch.setattr(OnPlant, "_seeds", lambda *_: [1])
    choice = cast(Choice, SimpleNamespace(beside=lambda *_: {0.4: large}))
    assert list(OnPlant(body_problem(1.0), RHC).walk(choice, {"bold": small}, [], 1)) == kept


def test_a_lucky_trial_counts_with_its_worst_seed(monkeypatch):
    """What rings with one seed and not with another: a choice by one trial would be the one that was lucky."""
    lucky: list[Deformation] = []

    def two(choice: Choice) -> dict[str, Candidate]:
        found = forms(choice, "lucky", "steady")
        lucky.append(found["lucky"].deformation)
        return found

    def trial(_: OnPlant, deformation: Deformation, seed: int) -> Trial:
        error = {1: 0.1, 2: 0.1, 3: 0.8}[seed] if deformation in lucky else 0.3
        return Trial(error, error)

    monkeypatch.setattr(Choice, "shortlist", two)
    monkeypatch.setattr(Choice, "beside", lambda *_: {})
    monkeypatch.setattr(OnPlant, "trial", trial)
    found = fp.probe(body_problem(1.0, 0, 0.0, 0.05), RHC, cycles=100)
    assert found.why.startswith("steady")
    assert found.trials["lucky"].error == 0.8


@pytest.mark.parametrize(("noise", "runs"), [(0.0, 1), (0.05, 3)])
def test_other_seeds_are_tried_where_they_change_a_run(noise, runs):
    plant = OnPlant(replace(body_problem(1.0, 0, 0.0, noise), duration=0.5, measure_from=0.0), RHC)
    assert len(plant._seeds(1)) == runs


@pytest.mark.slow
def test_no_neighbour_of_the_choice_is_better():
    """On a plant with limits that the estimate lacks the best predicted share is too large; trials walk to the best."""
    task = fp.load_problem("van_der_pol")
    problem, controller = replace(task.problem, duration=5.0), task.controllers["RHC"]
    found = fp.probe(problem, controller, cycles=400)
    assert ", share " in found.why
    assert found.deformation is not None
    gain = found.deformation.effective_gain()
    others = {f"{f:g}": found.deformation.with_effective_gain(f * gain) for f in (0.6, 1.6)}
    plant = OnPlant(problem, controller)
    outcomes = {name: plant.trial(one, 1) for name, one in {"chosen": found.deformation, **others}.items()}
    errors = {name: one.error for name, one in outcomes.items() if isinstance(one, Trial)}
    assert len(errors) == 3
    assert errors["chosen"] == min(errors.values())


@pytest.mark.slow
def test_what_a_record_does_not_bound_is_adapted_by_trials_alone():
    """Forty cycles are a tenth of what a lag of .3 s takes: nothing is proposed untried."""
    problem = replace(body_problem(1.0, 0, 0.3, 0.05), duration=2.0)
    untried, found = (fp.probe(problem, RHC, cycles=60, trials=trials) for trials in (False, True))
    assert untried.why == "the record is too short for the lag: take more cycles"
    assert untried.deformation is None
    assert untried.why in found.notes
    assert found.deformation is None or found.trials[found.why.partition(":")[0]].passes


def test_the_budget_of_chatter_is_kept():
    """Steps of a millionth of the controller's own leave nothing to choose."""
    problem = body_problem(1.0, 0, 0.0, 0.3)
    found = fp.probe(problem, RHC, chatter=1e-6, trials=False)
    assert found.deformation is None
    assert "no setting" in found.why


def test_a_budget_of_chatter_that_every_trial_exceeds_is_named(monkeypatch):
    """With what is to give, something is kept."""
    monkeypatch.setattr(Choice, "shortlist", lambda choice: forms(choice, "bold"))
    problem = body_problem(1.6, 0, 0.0, 0.05)
    found = fp.probe(problem, RHC, cycles=100, chatter=1e-6)
    assert found.deformation is None
    (given,) = re.findall(r"budget of chatter; .* give chatter=(.*)", found.why)
    assert fp.probe(problem, RHC, cycles=100, chatter=float(given)).deformation is not None


# --- Recordings -------------------------------------------------------------------------------------------------------


def write_recording(path: Path, *, response: bool) -> fp.Problem:
    """Write a run of a body as a CSV file and return its problem."""
    problem = replace(body_problem(1.6, 2, 0.0, 0.02), duration=4.0)
    run = fp.simulate(problem, RHC, seed=3, compiled=False)
    columns = {"time": run["time"].ravel(), "u": run["command.u"], "q": run["state.q"], "q'": run["state.q'"]}
    columns |= {"q''": run["realised.q"]} if response else {}
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([list(columns), *zip(*columns.values(), strict=True)])
    return problem


@pytest.mark.parametrize("response", [True, False])
def test_a_recording_is_probed_without_a_run(tmp_path, monkeypatch, response):
    """Gain and dead time follow from a file, where the response is a column and where it is a difference of velocities."""
    if not response:  # what is chosen does not depend on how the response is recorded
        monkeypatch.setattr(Choice, "shortlist", lambda _: {})
    problem = write_recording(tmp_path / "run.csv", response=response)
    broken = replace(problem, reality=fp.ExternalPlant(Untouched(), QUANTITIES))
    found = fp.probe(broken, RHC, recording=tmp_path / "run.csv")
    assert found.dead_time["u"].value == 2
    assert found.gain["q"]["q"].low <= 1.6 <= found.gain["q"]["q"].high
    assert found.trials == {}


def test_a_recording_whose_input_never_changes_tells_nothing(tmp_path):
    """A drive at a constant current: the noise of its speed is no answer to it."""
    problem, noise = body_problem(1.0), np.random.default_rng(0).normal(size=(200, 2))
    rows = [(f"{k * PERIOD:.2f}", 4, *noise[k], 0.1 * noise[k, 0]) for k in range(200)]
    with (tmp_path / "run.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("time", "u", "q", "q'", "q''"), *rows])
    with pytest.raises(fp.FpirhcError, match="the input 'u' never changes, so nothing can be known of its gain"):
        fp.probe(problem, RHC, recording=tmp_path / "run.csv")


QUANTITIES = {"q": "m", "q'": "m/s", "q''": "m/s^2"}


class Untouched:
    """A body that fails the test where it is asked anything."""

    def reset(self, *_: object) -> list[float]:
        raise AssertionError("a recording needs no run")

    step = reset


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,u,q\n0,0,0\n0.01,0,0\n", "no column 'q''"),
        ("time,u,q,q',q''\n0,0,0,0,0\n0.02,0,0,0,0\n", "not 0.01 s apart"),
        ("time,u,q,q',q''\n0,0,0,x,0\n", "row 1 of numbers has 'x' for q'"),
        ("time,u,q,q',q''\n0,0,0,0,0\n0,0,0,0,0,0\n", "Expected 5 fields in line 3, saw 6"),
        ("time,u,q,q',q''\n0,0,0,0\n", "fewer than two rows"),
        ("", "expected a line of names"),
    ],
)
def test_a_wrong_recording_says_what_is_wrong(tmp_path, text, words):
    (tmp_path / "run.csv").write_text(text)
    with pytest.raises(fp.FpirhcError, match=words):
        fp.probe(body_problem(1.0), RHC, recording=tmp_path / "run.csv")


# --- Wrong arguments --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"cycles": 20}, "at least 40"),
        ({"amplitude": -1.0}, "expected a number of at least 0"),
        ({"amplitude": {"u": 1.0}}, "'u' is unknown"),
        ({"chatter": 0.0}, "expected a number above 0"),
        ({"chatter": {"q": 1.0}}, "'q' is unknown"),
        ({"recording": "nowhere.csv"}, "cannot be read"),
        ({"recording": "run.csv", "cycles": 300}, "^cycles is of an excitation, and a recording has been excited"),
        ({"recording": "run.csv", "amplitude": 0.0}, "^amplitude is of an excitation"),
    ],
)
def test_wrong_arguments_are_refused(arguments, words):
    with pytest.raises(fp.FpirhcError, match=words):
        fp.probe(body_problem(1.0), RHC, **arguments)


def test_a_candidate_that_the_loop_refuses_is_not_tried_and_the_others_are():
    """The motor's derivative is two cycles late: a filtered gain that is too large for it is refused before a run."""
    task = fp.load_problem("noisy_motor")
    controller = next(iter(task.controllers.values()))
    fast = fp.ModelReferenced(map=fp.Filtered(map=fp.Affine(gain=-0.991), pole=0.75))
    slow = fp.ModelReferenced(map=fp.Filtered(map=fp.Affine(gain=-0.1), pole=0.75))
    plant = OnPlant(task.problem, controller)
    assert "0 < |gain| < 0.413" in str(plant.trial(fast, 0))
    assert isinstance(plant.trial(slow, 0), Trial)


def test_a_sign_that_is_not_certain_is_asked_again_louder(monkeypatch):
    """An excitation half as large as usual in much noise leaves the sign open; 2.5 times as much settles it, and this is said."""
    monkeypatch.setattr("fpirhc.probing.recording._NOISES", 1.0)
    monkeypatch.setattr(Choice, "shortlist", lambda _: {})
    problem = body_problem(0.3, 2, 0.05, 2.0)
    quiet, found = (fp.probe(problem, RHC, cycles=60, seed=1, amplitude=one) for one in (0.0, None))
    assert quiet.why.startswith("the sign of a gain is not certain")
    assert quiet.notes == ()
    assert [note for note in found.notes if note.endswith("excited again, with 2.5 times the amplitude")]
    assert 0 < found.gain["q"]["q"].low <= 0.3 <= found.gain["q"]["q"].high


@pytest.mark.slow
def test_coupled_bodies_are_offered_a_gain_matrix():
    """Directions with gains of 1.3 and .2: the matrix is the inverse of the gains, and not behind the best single number."""
    problem = replace(body_problem([[0.8, 0.6], [0.5, 0.7]], 0, 0.0, 0.02), duration=2.0)
    found = fp.probe(problem, RHC, cycles=150)
    weighted = {n: one for n, one in found.candidates.items() if one.iteration.weights is not None}
    assert weighted
    for one in weighted.values():
        product = np.array(one.iteration.weights) @ np.array([[0.8, 0.6], [0.5, 0.7]])
        assert product == pytest.approx(np.eye(2), abs=0.15)
    hand = [fp.ModelReferenced(fp.Affine(gain=-2 * g / 1.3)) for g in (0.3, 0.6)]
    plant = OnPlant(problem, RHC)
    single = [one.error for one in (plant.trial(h, 1) for h in hand) if isinstance(one, Trial)]
    assert min(found.trials[name].error for name in weighted) <= min(single)


@pytest.mark.slow
def test_a_model_that_is_not_affine_in_its_input_has_a_choice():
    """The model is 20 tan(u / 20): no inverse in symbols is needed where all coordinates are controlled."""
    problem = body_problem(1.6, 0, 0.0, 0.02)
    bent = replace(problem.plant, response=lambda q, v, u, p: {"q": p.b * 20 * ca.tan(u.u / 20)})
    task = replace(problem, plant=bent, limits=fp.Limits(inputs={"u": (-15.0, 15.0)}), duration=2.0)
    found = fp.probe(task, RHC, cycles=100)
    assert found.deformation is not None
    assert min(one.error for one in found.trials.values()) < 0.3
