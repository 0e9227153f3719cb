"""The samples that an export is replayed with, faults included, and what the controller answers to them here."""

from __future__ import annotations

import struct

import numpy as np

from fpirhc.export.device import Device
from fpirhc.simulation.simulate import simulate
from fpirhc.task.problem import Problem

_OFFSET, _PRIME, _MASK = 0xCBF29CE484222325, 0x100000001B3, (1 << 64) - 1
_NAN = 0x7FF8000000000000
_CYCLES = 2000  # of a record


def recorded(device: Device) -> bytes:
    """Return the file: a head of four 32-bit numbers (cycles, numbers given, commands, whether bits count), and the cycles.

    Bits do not count where there is no compiler and a plan was solved by the virtual machine, which rounds in another order.

    Samples are those of a run, again from its beginning where it is too short; a plant outside is not run, but its model is.
    """
    stepper = device.stepper
    rows = with_faults(_samples(device), device.problem)[:_CYCLES]
    exact = stepper.compiled or stepper.function.is_a("SXFunction")
    head = struct.pack("<4i", len(rows), rows.shape[1], device.problem.plant.input.size, exact)
    memory, parts = stepper.start(), [head]
    for k, row in enumerate(rows):
        damaged = memory.size - 3 if k == _DAMAGED else -1
        if damaged >= 0:
            memory = memory.copy()
            memory[damaged] = np.nan
        command, memory = stepper.step_measured(row[0], row[1:], memory)
        trace = np.concatenate([value.ravel() for value in stepper.trace().values()])
        parts += [
            row.tobytes(),
            struct.pack("<d", damaged),
            command.tobytes(),
            struct.pack("<2Q", digest(memory), digest(trace)),
        ]
    return b"".join(parts)


_GAPS = ((150, 3), (220, 30), (300, 700))  # first cycle behind a gap, and the number of missing ones
_DAMAGED = 95  # cycle before which an entry of the memory becomes NaN


def with_faults(rows: np.ndarray, problem: Problem) -> np.ndarray:
    """Return samples with what a device meets: no numbers, outliers, a plant that jumped, and cycles that are missing.

    Behind a gap the samples are those of its end, as the reference is: others would keep the commands at their limits.
    """
    place = np.arange(len(rows))
    for first, missing in _GAPS:
        place[first:] += missing
    rows = rows[place % len(rows)]
    rows[:, 0] = problem.period * place
    # main.c knows the first outlier, that of cycle 40.
    faults: dict[int, tuple[int, float]] = {
        20: (1, np.nan), 25: (-1, np.inf), 30: (-1, -np.inf), 35: (0, np.nan), 40: (1, 1e9), 41: (1, 1e9), 42: (1, 1e9),
        50: (-1, 1e200), 52: (0, 1e18), 53: (1, -np.inf),
    }  # fmt: skip
    for k, (entry, value) in faults.items():
        rows[k : k + 1, entry] = value
    rows[60:85, 1] += 1e4
    rows[350:351, 0] = rows[349:350, 0]  # a cycle twice
    return rows


def digest(values: np.ndarray) -> int:
    """Return FNV-1a of the bits of the numbers, eight bytes at a time."""
    bits = np.where(np.isnan(values), np.uint64(_NAN), values.view(np.uint64))
    total = _OFFSET
    for one in bits.tolist():
        total = ((total ^ one) * _PRIME) & _MASK
    return total


def _samples(device: Device) -> np.ndarray:
    """What the step is given in a run, with times that go on where it is repeated, and as many cycles more as gaps are long."""
    problem = device.problem
    run = simulate(problem.of_equations, device.controller, seed=0)
    parts = (run.time if name == "time" else run[name] for name in device.inputs.names)
    rows = np.hstack([np.asarray(part, dtype=float).reshape(len(run.time), -1) for part in parts])
    wanted = _CYCLES + sum(missing for _, missing in _GAPS)
    rows = np.vstack([rows] * -(-wanted // len(rows)))[:wanted]
    rows[:, 0] = device.problem.period * np.arange(len(rows))
    return rows
