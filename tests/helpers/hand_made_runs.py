"""Runs that are made by hand, on a plant with one coordinate [m] and one input [N]."""

import casadi as ca
import numpy as np

import fpirhc as fp
from fpirhc.contracts import Layout, Signal, scalar
from helpers.plants import linear

PERIOD, CYCLES = 0.1, 100
SOLVE = ("cost", "stationarity", "feasibility", "iterations", "status")


def problem(**changes) -> fp.Problem:
    """A plant with one coordinate [m] and one input [N], measured from the second half of a run on."""
    settings = {
        "plant": linear(1.0, 1.0),
        "start": {"y": 0.0},
        "period": PERIOD,
        "duration": PERIOD * CYCLES,
        "measure_from": 5.0,
    }
    return fp.Problem(reference=fp.Trajectory(lambda t: {"y": ca.sin(t)}), **{**settings, **changes})


def run(error, *, reference=None, clipped=0.0, command=0.0, status=0, stop=None, **more) -> fp.Run:
    """A run with this error of 'y' in every cycle; `more` are further signals (name -> columns)."""
    error = np.broadcast_to(np.asarray(error, dtype=float), (CYCLES,))
    reference = np.linspace(0.0, 1.0, CYCLES) if reference is None else reference
    motion = np.column_stack([reference - error, 0 * reference])
    signals = {
        "time": (scalar("time", "s"), PERIOD * np.arange(CYCLES)),
        "reference": (Signal("reference", ("y", "y'"), ("m", "m/s")), np.column_stack([reference, 0 * reference])),
        "state": (Signal("state", ("y", "y'"), ("m", "m/s")), motion),
        "error": (Signal("error", ("y",), ("m",)), error),
        "command": (Signal("command", ("u",), ("N",)), command),
        "clipped": (scalar("clipped"), clipped),
        "status": (scalar("status"), status),
        **more,
        "plant_state": (Signal("plant_state", ("y", "y'"), ("m", "m/s")), motion),
        "true_error": (Signal("true_error", ("y",), ("m",)), error),
    }
    log = np.hstack([np.broadcast_to(np.asarray(v, float).T, (s.size, CYCLES)).T for s, v in signals.values()])
    layout, cycles = Layout(tuple(s for s, _ in signals.values())), CYCLES if stop is None else CYCLES // 4
    return fp.Run("case", "CTC", 0, PERIOD, layout, log[:cycles], stop, False, {})


def step(before, after, cycle):
    """`before` up to a cycle, `after` from it on."""
    return np.where(np.arange(CYCLES) < cycle, before, after)
