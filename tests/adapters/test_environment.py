"""A problem as a Gymnasium environment: the commands of a run give the motion of the run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fpirhc as fp
from fpirhc.adapters.environment import as_env
from fpirhc.controllers.base import Controller

pytest.importorskip("gymnasium", reason="it needs the extra fpirhc[outside]")


def task(name: str) -> tuple[fp.Problem, Controller]:
    loaded = fp.load_problem(name)
    problem = replace(loaded.problem, duration=30 * loaded.problem.period, measure_from=0.0)
    return problem, loaded.controllers["CTC"] if "CTC" in loaded.controllers else next(
        iter(loaded.controllers.values())
    )


@pytest.mark.parametrize("name", ["two_link_arm", "delayed_mass", "noisy_motor", "leaking_tanks", "freeway"])
def test_the_commands_of_a_run_give_its_motion(name):
    """Dead time, noise and quantisation of the sensors, physical ranges, a map: bit by bit."""
    problem, controller = task(name)
    run = fp.simulate(problem, controller, seed=5, compiled=False)
    env = as_env(problem)
    env.reset(seed=5)
    for command, state in zip(run["command"][:-1], run["state"][1:], strict=True):
        seen, _, terminated, _, signals = env.step(command)
        assert not terminated
        assert np.array_equal(signals["state"], state)
        assert np.array_equal(seen[: state.size], state)


@pytest.mark.filterwarnings("ignore:.*WARN")
def test_gymnasium_finds_nothing_wrong():
    from gymnasium.utils.env_checker import check_env

    check_env(as_env(task("two_link_arm")[0]), skip_render_check=True)


def test_seeds_repeat_and_an_episode_ends_in_time():
    env = as_env(task("noisy_motor")[0])
    episodes = []
    for seed in (1, 1, 2):
        seen, _ = env.reset(seed=seed)
        rows, over = [seen], False
        while not over:
            seen, reward, terminated, over, signals = env.step(np.zeros(env.action_space.shape))
            assert reward == pytest.approx(-float(signals["error"] @ signals["error"]))
            assert not terminated
            rows.append(seen)
        episodes.append(np.array(rows))
    assert len(episodes[0]) == 31
    assert np.array_equal(episodes[0], episodes[1])
    assert not np.array_equal(episodes[0], episodes[2])


def test_set_points_are_those_of_a_run():
    """A set-point that changes within the episode, in the observation and in the motion, bit by bit."""
    problem, controller = task("two_link_arm")
    plant = problem.plant
    reference = fp.Setpoint(dict.fromkeys(plant.names, 0.1), rate=0.2 / problem.period)
    problem = replace(problem, reference=reference)
    steps = {plant.names[0]: ((0.0, 0.1), (10.5 * problem.period, 0.4))}
    controller = fp.ComputedTorque(fp.Exponential(rate=4.0))
    run = fp.simulate(problem, controller, seed=5, compiled=False, setpoints=steps)
    env = as_env(problem, setpoints=steps)
    env.reset(seed=5)
    for command, state, reference in zip(run["command"][:-1], run["state"][1:], run["reference"][1:], strict=True):
        seen, *_ = env.step(command)
        assert np.array_equal(seen, [*state, *reference])
    assert np.ptp(run["reference"][:, 0]) > 0.1


@pytest.mark.parametrize("seed", ["a", -1, 1.5, True])
def test_a_wrong_seed_is_named_with_what_was_expected(seed):
    with pytest.raises(fp.FpirhcError, match=r"reset\.seed: expected a whole number of at least 0 or None, got"):
        as_env(task("two_link_arm")[0]).reset(seed=seed)


@pytest.mark.parametrize(
    ("reward", "words"),
    [
        (lambda signals: signals["errr"], "KeyError: 'errr'"),
        (lambda _: None, "it returned [None], expected one number"),
    ],
)
def test_a_wrong_reward_is_told_when_the_environment_is_made(reward, words):
    with pytest.raises(fp.FpirhcError, match=r"as_env\(reward=...\)") as caught:
        as_env(fp.load_problem("two_mass").problem, reward=reward)
    assert words in str(caught.value)
