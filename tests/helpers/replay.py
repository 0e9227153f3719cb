"""A run given again to a Stepper, sample by sample: what a controller on a machine would have commanded."""

import numpy as np

import fpirhc as fp


def status(stepper: fp.Stepper) -> fp.Status:
    """That of the last step."""
    return fp.Status(int(stepper.trace()["status"][0]))


def samples(run: fp.Run) -> np.ndarray:
    """What `step_measured` is given in every cycle, shape (cycles, measurements): NaN where it was lost."""
    arrived = next((name for name in ("arrived", "measured") if name in run.layout), None)
    given = [name for name in ("state", "output", "realised") if name in run.layout]
    if arrived is not None:  # a state that is logged before the measurements is not made from them
        names = run.layout.names
        known = "output" in run.layout and names.index("state") < names.index(arrived)
        given = ["state", arrived] if known else [arrived]
    rows = np.hstack([run[name].reshape(run.cycles, -1) for name in given])
    if "lost_sample" in run.layout:
        rows[run["lost_sample"].ravel() > 0] = np.nan
    return rows


def replayed(stepper: fp.Stepper, run: fp.Run, rows: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Commands and statuses of a Stepper that is given the samples of a run, or other ones at the same times."""
    memory, commands, statuses = stepper.start(), [], []
    for time, row in zip(run.time, samples(run) if rows is None else rows, strict=True):
        command, memory = stepper.step_measured(float(time), row, memory)
        commands.append(command)
        statuses.append(status(stepper))
    return np.array(commands), np.array(statuses)
