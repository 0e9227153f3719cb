"""Wrong files and command lines as they are written by people who come from other tools: what each message must say.

Each case changes a correct file (`first_files`) and runs a command on it. The message names what is wrong, where, what was
expected, and a fix; all mistakes of one file stand in it; the exit code is that of bad input, or of a review that answers no.
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass, field
from inspect import signature
from pathlib import Path

import pytest
from first_files import PENDULUM, REACTOR, TANKS, changes_of, messages_of

import fpirhc as fp
from fpirhc.cli.main import main
from fpirhc.cli.verb import ExitCode
from fpirhc.errors import OF_OTHER_TOOLS
from fpirhc.fields.checked import Checked, field_names

REVIEW = ("review", "mine.py")
BESIDE = {
    "notes.txt": "x = 1\n",
    "two_mess.py": "1 / 0\n",
    "empty.csv": "",
    "words.csv": "# of Monday\n\ntime,angle\n0,abc\n",
    "other.csv": "time,phi\n0,1\n0.02,1\n",
    "short.csv": "a,b\n1\n",
    "folder.py/kept": "",
}


@dataclass(frozen=True)
class Wrong:
    """A changed file and what must be said about it.

    Args:
        file: the correct file.
        changes: (old, new) pieces of it.
        said: what stands in the message, in this order.
        words: of the command line.
        beside: other files of the folder.
        code: of the exit; None for one of those that say no.
    """

    file: str
    changes: tuple[tuple[str, str], ...]
    said: tuple[str, ...]
    words: tuple[str, ...] = REVIEW
    beside: dict[str, str] = field(default_factory=dict)
    code: ExitCode | None = None


def one(file: str, old: str, new: str, *said: str) -> Wrong:
    """One change, reviewed."""
    return Wrong(file, ((old, new),), said)


# Changes of a correct file: the name of the mistake, the old piece and the new one, and what must be said, in this order.
WRONG_PENDULUM = """
a number with its unit
  period=1e-2 -> period="10 ms"
    Problem.period: expected a number ... write the number alone, in the unit that is expected
one end of a limit
  "torque": (-15.0, 15.0) -> "torque": 15.0
    Limits.inputs['torque']: expected (a number, a number), got 15.0; write both ends, such as (-15.0, 15.0)
a derivative in the reference
  {"angle": 0.8 * ca.sin(2 * t)} -> {"angle": 0.8 * ca.sin(2 * t), "angle'": 1.6 * ca.cos(2 * t)}
    'angle'' is taken from 'angle' by differentiation; leave it out
right-hand side as a vector
  return {"angle": (u.torque - p.friction * v.angle) / inertia - 9.81 / p.length * ca.sin(q.angle)} ->
      return ca.vertcat(v.angle, u.torque / inertia)
    mine.py, line 12: plant = fp.Plant( ... response must return {name: expression}, got a CasADi expression ... return {'name':
    expression, ...}
response of x and u
  def response(q, v, u, p): -> def response(x, u):
    response takes 2 arguments (mine.py, line 7) ... it is called as response(q, v, u, p) ... Plant.of_states(rates=...)
order of a velocity
  order=2 -> order=1
    called as response(q, u, p); 4 arguments are those of order 2
parameters as numbers
  fp.Parameter(approximate=1.4, exact=1.0, unit="kg") -> 1.4
  fp.Parameter(approximate=0.5, exact=0.6, unit="m") -> (0.5, 0.6)
    ['mass']: expected a Parameter, got 1.4; write fp.Parameter(approximate=..., exact=..., unit=...) ... ['length']: expected a
    Parameter
unit in front
  fp.Parameter(approximate=1.4, exact=1.0, unit="kg") -> fp.Parameter("kg", 1.0, 1.4)
    mine.py, line 18 ... the values of 'approximate' and 'unit' are swapped; write Parameter(approximate=..., unit=...)
names without units
  {"angle": "rad"} -> ["angle"]
  {"torque": "N m"} -> "torque"
    Plant.coordinates: expected {name: a text}, got ['angle'] ... Plant.inputs: expected {name: a text}, got the text 'torque'
unit as a name
  {"angle": "rad"} -> {"rad": "angle"}
    line 9): coordinate 'angle' is unknown. Valid: rad.
entries by number
  q.angle -> q[0]
    line 9): coordinate '0' is unknown. Entries have names, such as .angle, and no numbers.
MX in a response
  ca.sin(q.angle) -> ca.sin(ca.MX(1) * q.angle)
    line 9): the symbols here are of the kind SX, which cannot be mixed with MX
parameters without a number
  approximate=1.4, exact=1.0 -> approximate=float("nan"), exact=float("inf")
    parameter 'mass': approximate is nan, expected a finite number; look at what computes it ... parameter 'mass': exact is inf,
    expected a finite number
names of another tool
  period=1e-2 -> dt=1e-2
  duration=0.2 -> T=0.2
  start={ -> x0={
    no field 'x0'. Did you mean 'start'? ... no field 'dt'. Did you mean 'period'? ... no field 'T'. Did you mean 'duration'? ...
    Problem needs start, period, duration
start as an array
  start={"angle": 0.0} -> start=np.zeros(2)
    Problem.start: expected {name: a finite number}, got an array of the shape (2,)
limits by vectors
  fp.Limits(inputs={"torque": (-15.0, 15.0)}) -> fp.Limits(lbu=np.array([-15.0]), ubu=np.array([15.0]))
    mine.py, line 29 ... no field 'lbu'. Did you mean 'inputs'? ... no field 'ubu'. Did you mean 'inputs'?
limits as a mapping
  fp.Limits(inputs={"torque": (-15.0, 15.0)}) -> {"torque": (-15.0, 15.0)}
    Problem.limits: expected a Limits ... write fp.Limits(inputs=...)
limits of unknown names
  fp.Limits(inputs={"torque": (-15.0, 15.0)}) -> fp.Limits(inputs={"tau": (-15.0, 15.0)}, states={"angle_dot": (-3, 3)})
    input 'tau' is unknown. Valid: torque. ... state 'angle_dot' is unknown. Did you mean 'angle''?
cost by matrices
  fp.Quadratic(states={"angle": 1e3, "angle'": 1.0}, deviation={"torque": 1e-2}) ->
      fp.Quadratic(Q=np.diag([1e3, 1.0]), R=np.eye(1))
    no field 'Q'. Did you mean 'states'? ... no field 'R'. Did you mean 'effort'?
cost as a function
  fp.Quadratic(states={"angle": 1e3, "angle'": 1.0}, deviation={"torque": 1e-2}) -> lambda x, u: x[0] ** 2
    Problem.cost: expected a Cost or None, got the function <lambda>(x, u); one of CustomCost, Quadratic
cost on unknown names
  fp.Quadratic(states={"angle": 1e3, "angle'": 1.0}, deviation={"torque": 1e-2}) ->
      fp.Quadratic(states={"theta": 1.0}, effort={"force": 1e-2}, terminal={"angle_dot": 1.0})
    states: 'theta' is unknown ... effort: 'force' is unknown. Did you mean 'torque'? ... terminal: 'angle_dot' is unknown. Did
    you mean 'angle''?
cost of an unknown member
  fp.Quadratic(states={"angle": 1e3, "angle'": 1.0}, deviation={"torque": 1e-2}) -> fp.CustomCost(lambda v: {"e": v.x.angle**2})
    line 31): a View has no 'x' ... Valid: state, reference, input
horizon by one number
  fp.Horizon(stages=6, step=2e-2) -> 20
    expected a Horizon or None, got 20; write fp.Horizon(stages=..., step=...)
horizon of another tool
  stages=6, step=2e-2 -> n_horizon=20, t_step=2e-2
    no field 'n_horizon'. Did you mean 'stages'? ... no field 't_step'. Did you mean 'step'? ... Horizon needs stages, step
step before stages
  fp.Horizon(stages=6, step=2e-2) -> fp.Horizon(2e-2, 6)
    Horizon.stages: expected a whole number from 1 to 1000000, got 0.02
reference as a number
  fp.Trajectory(lambda t: {"angle": 0.8 * ca.sin(2 * t)}) -> 0.8
    Problem.reference: expected a Reference, got 0.8; one of Setpoint, Table, Trajectory
reference without a function
  fp.Trajectory(lambda t: {"angle": 0.8 * ca.sin(2 * t)}) -> fp.Trajectory({"angle": 0.8})
    mine.py, line 25 ... expected a function of 1 argument ... write lambda t: {'angle': 0.8}
reference that is not finite
  0.8 * ca.sin(2 * t) -> ca.sqrt(t)
    mine.py, line 23 ... reference: at t = 0 s angle' is inf, angle'' is -inf ... give a motion that has these values
response that divides by zero
  ca.sin(q.angle) -> ca.sin(q.angle) / q.angle
    the response of 'angle' (approximate parameters) is not finite at the start (angle = 0, angle' = 0) ... start elsewhere, or
    change what is divided by zero there
reference that jumps
  0.8 * ca.sin(2 * t) -> ca.sign(ca.sin(2 * t))
    no Is the reference free of jumps? angle by 2 rad at t = 0 s ... Use a filtered set-point
period of zero
  period=1e-2 -> period=0
    Problem.period: expected a number from 1e-12 to 1e12 in the plant's unit of time, got 0
period above the run
  period=1e-2 -> period=10.0
    duration 0.2 s is shorter than one period of 10.0 s ... period 10 s does not divide the horizon step 0.02 s
measured after the end
  measure_from=0.05 -> measure_from=5.0
    measure_from must lie in [0, 0.2), got 5.0
disturbance without a name
  measure_from=0.05 -> disturbances=fp.Sine(0.1, 1.0)
    expected {name: a Disturbance}, got a value of the class Sine; write {'NAME': Sine(...)} with the name of what it belongs to
disturbance as a number
  measure_from=0.05 -> disturbances={"torque": 0.5}
    expected a Disturbance, got 0.5; one of ColouredNoise, Formula, Noise
dead time as a number
  measure_from=0.05 -> dead_time=0.05
    expected a DeadTime, got 0.05; write fp.DeadTime(inputs=...)
noise as a number
  measure_from=0.05 -> sensing=fp.Sensing(sensors={"angle": fp.Sensor(noise=0.01)})
    Sensor.noise: expected a Disturbance or None, got 0.01
deformation before the optimiser
  fp.RecedingHorizon(optimiser, adaptive) -> fp.RecedingHorizon(adaptive, optimiser)
    the values of 'optimiser' and 'deformation' are swapped
deformation as a number
  fp.ModelReferenced(fp.Sigmoid(gain=-2.6)) -> fp.ModelReferenced(-2.6)
    ModelReferenced.map: expected a Deformation, got -2.6; one of Affine
gains of a PID
  {"RHC": fp.RecedingHorizon(optimiser) -> {"PID": fp.PID(Kp=9.0, Kd=1.0)
    no field 'Kp'. Did you mean 'proportional'? ... no field 'Kd'. Did you mean 'derivative'?
options of a solver
  fp.FixedPoint(iterations=1, tolerance=1e-2) -> fp.Ipopt(max_iter=100)
    Ipopt has no field 'max_iter'. Did you mean 'iterations'?
class of another tool
  {"RHC": fp.RecedingHorizon(optimiser), "RHC+FPI": fp.RecedingHorizon(optimiser, adaptive)} -> {"MPC": fp.MPC(optimiser)}
    fpirhc has no name 'MPC'. Did you mean 'RecedingHorizon'? ... more.
one controller
  {"RHC": fp.RecedingHorizon(optimiser), "RHC+FPI": fp.RecedingHorizon(optimiser, adaptive)} -> fp.RecedingHorizon(optimiser)
    line 36: it must define controllers = {'name': fpirhc.ComputedTorque(...), ...}, got a value of the class RecedingHorizon
controllers under another name
  controllers = { -> controller = {
    'controller' is such a mapping, so call it 'controllers'
parenthesis that stays open
  reference=fp.Trajectory(lambda t: {"angle": 0.8 * ca.sin(2 * t)}), ->
      reference=fp.Trajectory(lambda t: {"angle": 0.8 * ca.sin(2 * t)},
    mine.py, line 23: '(' was never closed problem = fp.Problem(
"""
WRONG_REACTOR = """
rates of time
  def rates(x, u, p) -> def rates(t, x, u, p)
    rates takes 4 arguments (mine.py, line 7); it is called as rates(x, u, p)
output as a function
  fp.Output("K", lambda x, p: x.T) -> lambda x, p: x.T
    Plant.outputs['temperature']: expected an Output ... write fp.Output(unit=..., expression=...)
output before its unit
  fp.Output("K", lambda x, p: x.T) -> fp.Output(lambda x, p: x.T, "K")
    mine.py, line 20 ... the values of 'unit' and 'expression' are swapped
output of the state alone
  lambda x, p: x.T -> lambda x: x.T
    called as function(x, p) ... got the function <lambda>(x); write lambda x, p: ...
output of an unknown state
  lambda x, p: x.T -> lambda x, p: x.C_A
    'temperature' (mine.py, line 20): state 'C_A' is unknown ... Valid: C, T.
start in another unit
  "T": 350.0} -> "T": "77 C"}
    Problem.start['T']: expected a finite number, got the text '77 C'
start of an output
  start={"C": 0.5, "T": 350.0} -> start={"temperature": 350.0}
    start: state 'temperature' is unknown. Valid: C, T. ... state 'C' has no first value; add 'C' ... state 'T' has no first
    value
weights of states behind an output
  outputs={"temperature": 1.0}, rate -> states={"T": 1.0}, rate
    weigh temperature, Quadratic(outputs=...)
"""
WRONG_TANKS = """
start outside the limits
  start={"h1": 1.0 -> start={"h1": 3.0
    no Does the run start inside the limits of states? h1 starts at 3 m, limits 0 and 2 ... Move the start of h1 inside the limits
limits reversed
  "pump1": (0.0, 2.0) -> "pump1": (2.0, 0.0)
  {"h1": (0.0, 2.0)} -> {"h1": (2.0, 0.0)}
    'pump1' has lower 2.0 above upper 0.0; swap them ... 'h1' has lower 2.0 above upper 0.0; swap them
gain of the wrong sign
  gain=-0.7 -> gain=0.7
    no Is the map's gain admissible? gain = 0.7; the smallest limit is -4 ... Use gain = -2
"""
OTHERS = {
    "no input in the response": one(
        PENDULUM, "u.torque - ", "0 - ", "no input reaches coordinate 'angle'", "use torque in the response"
    ),
    "two inputs for one coordinate": Wrong(
        PENDULUM,
        (('{"torque": "N m"}', '{"torque": "N m", "brake": "N m"}'), ("u.torque - ", "u.torque - u.brake - ")),
        (
            "2 inputs (torque, brake) for 1 of the coordinates (angle): each input holds one",
            "leave an input out",
            "docs/models.md",
        ),
    ),
    "controlled by one name": Wrong(
        TANKS,
        (
            (', "pump2": "m^3/s"', ""),
            ("u.pump2 + ", ""),
            (', "pump2": (0.0, 2.0)', ""),
            ("order=1,", 'order=1,\n    controlled="h1",'),
        ),
        ("Plant.controlled: expected (a text, ...) or None, got the text 'h1'; write ('h1',)",),
    ),
    "a horizon that is not there": one(
        PENDULUM,
        "    horizon=fp.Horizon(stages=6, step=2e-2),\n",
        "",
        "no Does the controller fit the problem? RecedingHorizon needs Problem(horizon=...), which this problem does not have",
    ),
    "headline of unknown names": one(
        PENDULUM,
        "controllers = {",
        'headline = ("MPC", "RHC+FPi")\ncontrollers = {',
        "'MPC' is unknown",
        "'RHC+FPi' is unknown. Did you mean 'RHC+FPI'?",
    ),
    "headline of no pair": one(
        PENDULUM,
        "controllers = {",
        'headline = ("RHC+FPI", "RHC")\ncontrollers = {',
        "headline ('RHC+FPI', 'RHC') is no pair: expected a controller and the same one with adaptation; write ('RHC', 'RHC+FPI')",
    ),
    "mistakes all over the file": Wrong(
        PENDULUM,
        (
            ("import numpy as np\n", "import numpy as np\nimport do_mpc_\n"),
            ('unit="kg"', 'units="kg"'),
            ("exact=0.6", 'exact="0.6"'),
            ("period=1e-2", 'period="1e-2"'),
            ("stages=6", "n_horizon=6"),
            ("gain=-2.6", 'gain="big"'),
        ),
        (
            "line 4: import do_mpc_ ModuleNotFoundError",
            "line 19:",
            "no field 'units'. Did you mean 'unit'?",
            "line 20:",
            "Parameter.exact: expected a finite number",
            "line 24:",
            "Problem.period: expected a number",
            "write 1e-2 without quotes",
            "line 31:",
            "no field 'n_horizon'",
            "line 36:",
            "Sigmoid.gain: expected a finite number other than zero (no adaptation is Identity()), got the text 'big'",
        ),
    ),
    "key that is not there": one(
        PENDULUM,
        "optimiser = fp",
        "n = {}['max_iter']\noptimiser = fp",
        "mine.py, line 34: n = {}['max_iter'] KeyError: 'max_iter'",
    ),
    "data that are not there": one(
        PENDULUM,
        "optimiser = fp",
        'table = np.loadtxt("gone.csv")\noptimiser = fp',
        "line 34: table = np.loadtxt",
        "gone.csv not found",
    ),
    "everything in a function": one(
        PENDULUM,
        "problem = fp.Problem(",
        "def main():\n  problem = fp.Problem(",
        "it must define problem = fpirhc.Problem(...), outside every function",
    ),
    "circular imports": Wrong(
        PENDULUM,
        (("import fpirhc as fp", "import fpirhc as fp\nfrom helper import LENGTH"),),
        ("mine.py, line 5: from helper import LENGTH", "circular import"),
        beside={"helper.py": "from mine import response\nLENGTH = 1.0\n"},
    ),
    "name that a neighbour lacks": Wrong(
        PENDULUM,
        (("import fpirhc as fp", "import fpirhc as fp\nfrom helper import LENGTH"),),
        ("mine.py, line 5", "helper has no name 'LENGTH'. Did you mean 'LENGHT'?"),
        beside={"helper.py": "LENGHT = 1.0\n"},
    ),
    "adapter that is no name of the top level": Wrong(
        PENDULUM,
        (("import fpirhc as fp", "import fpirhc as fp\nfrom fpirhc import as_env"),),
        ("mine.py, line 5", "write: from fpirhc.adapters.environment import as_env"),
    ),
    "equations of MATLAB": Wrong("function dx = f(t, x)\n", (), ("mine.py, line 1: invalid syntax",)),
    "nothing": Wrong("", (), ("it must define problem = fpirhc.Problem(...)", "it must define controllers = {")),
}


def changed(file: str, table: str) -> dict[str, Wrong]:
    return {name: Wrong(file, tuple(changes), said) for name, (changes, said) in changes_of(table).items()}


FILES = changed(PENDULUM, WRONG_PENDULUM) | changed(REACTOR, WRONG_REACTOR) | changed(TANKS, WRONG_TANKS) | OTHERS
# Command lines beside a correct file: the words, and what must be said, in this order.
REFUSED = """
compare nofile => problem 'nofile' is unknown. Give the path of a problem file, or a name from 'fpirhc list'
compare mien.py => no file at 'mien.py'. Did you mean 'mine.py'?
compare mine => problem 'mine' is unknown; for the file write 'mine.py'
compare Two_Mass => Did you mean 'two_mass'?
compare . => '.' is a folder; a problem file ends in .py, such as mine.py, two_mess.py
compare notes.txt => 'notes.txt' is not a Python file; a problem file ends in .py
mine.py => the command 'mine.py' is unknown. Write fpirhc compare mine.py.
reveiw mine.py => Did you mean 'review'?
review mine.py --controler RHC => the option '--controler' is unknown. Did you mean '--controllers'? ... See fpirhc review --help.
--verion => the option '--verion' is unknown. Did you mean '--version'? ... See fpirhc --help.
compare => PROBLEM (name of a shipped problem, or path of a problem file) is missing. See fpirhc compare --help.
run => problem file) and CONTROLLER (name of a controller of the problem; 'fpirhc review PROBLEM' lists them) are missing.
compare mine.py --seed abc => --seed: expected a whole number of at least 0, got 'abc'.
compare mine.py --seed => --seed needs a value: --seed K. See fpirhc compare --help.
compare mine.py --s 3 => the option '--s' may be --seed, --set, --scenarios or --shard; write the whole name.
compare mine.py --mismatch x => --mismatch: expected percent of at least 0, such as 20%, got 'x'.
completion basch => SHELL 'basch' is unknown. Did you mean 'bash'? Valid: bash, zsh, fish, tcsh.
compare mine.py two_mass => 'two_mass' is a word too many; write fpirhc compare PROBLEM [options]
compare mine.py --controllers RHC,RHC+FPI => controller 'RHC,RHC+FPI' is unknown ... names are separated by spaces, without commas
compare mine.py --mismatch 20 => --mismatch needs --scenarios N
review mine.py --mismatch 120% => mismatch 120: expected percent of at least 0 and below 100, where a parameter keeps its sign
run mine.py fpi => controller 'fpi' is unknown. Did you mean 'RHC+FPI'?
run mine.py RHC+FPI --set gain=-2 => Did you mean 'optimiser.map.gain' or 'deformation.map.gain'?
run mine.py RHC+FPI --set deformation.gain=-2 => has no 'gain'. Did you mean 'deformation.map.gain'?
run mine.py RHC --set mass=2 => Parameters (exact and approximate) and the start are data of every loop
new ../my-arm => '../my-arm' is no name for a problem ... Try 'my_arm'; a folder is given by --dir
new class => 'class' cannot be the name of a problem: it is a word of Python. Try 'my_class'
new two_mass => 'two_mass' cannot be the name of a problem: a shipped problem has it ... Try 'my_two_mass'
new numpy => a module of that name is installed, which the file would hide from everything beside it.
review folder.py => 'folder.py' is a folder; a problem file ends in .py
review mine.py --controllers => --controllers needs a value: --controllers NAME. See fpirhc review --help.
review mine.py --controllers RCH abc =>
    1. controller 'RCH' is unknown. Did you mean 'RHC'? ... 2. controller 'abc' is unknown. Valid: RHC, RHC+FPI.
review mine.py --mismatch -5 => --mismatch: expected percent of at least 0, such as 20%, got '-5'.
review mine.py --mismatch nan => --mismatch: expected percent of at least 0, such as 20%, got 'nan'.
compare mine.py --headline rms_error => has a number for every coordinate; give one: 'rms_error.NAME'
compare mine.py --headline rms_error.angel => is unknown. Did you mean 'rms_error.angle'?
compare mine.py --headline max_error.phi => is unknown. Did you mean 'max_error.angle'? Valid: max_error.angle.
compare mine.py --headline effort.torque => metric 'effort.torque' has no better direction
compare mine.py --headline '' => metric '' is unknown. Valid: relative error, cycles, rms_error
compare mine.py --tuned gone.json => 'gone.json': No such file ... 'fpirhc tune mine' writes such a file
compare mine.py --scenarios 0 => --scenarios: expected a whole number of at least 1, got '0'.
compare mine.py --scenarios 10000000000 --mismatch 9 => scenarios 10000000000: expected at least 1, and at most 10000000
compare mine.py --processes 2 => --processes needs --scenarios N, the number of scenarios
compare two_mass --optimisers all --controllers CTC => plans with an optimiser
run mine.py RHC RHC+FPI => 'RHC+FPI' is a word too many; write fpirhc run PROBLEM CONTROLLER [options].
run mine.py RHC --duration 0 => '--duration' is unknown; write Problem(duration=...) in the problem file.
run mine.py RHC --dead-time 1 => write Problem(dead_time=...) in the problem file.
run mine.py RHC --set =3 => --set =3: expected PATH=NUMBER
run mine.py RHC+FPI --set deformation.map.gain=abc => expected PATH=NUMBER, such as deformation.gain=-1.2
run mine.py RHC+FPI --set deformation.map.gain=nan => expected a number or (a number, ...), got nan
run mine.py RHC --set limits.inputs.torque=5 => is an interval: expected a pair (lower, upper), got 5.0
run mine.py RHC --set setpoints.angle=2 => a Trajectory, has no set-points; use fp.Setpoint(...)
run mine.py RHC --set optimiser.iterations=0 => FixedPoint.iterations: expected a whole number from 1
run mine.py RHC --case adult => problem 'mine' has no cases; add cases = fpirhc.Cases({...}) to its file
solve mine.py --tolerance 0 => --tolerance: expected a number above 0, got '0'. See fpirhc solve --help.
solve mine.py --optimisers => --optimisers needs a value: --optimisers NAME. See fpirhc solve --help.
tune mine.py => no search space for tuning; add to its file ... tuning = {'RHC+FPI': {'deformation.map.gain':
tune two_mass --trials 10000000000 => trials 10000000000: expected at least 1, and at most 1000000
tune mine.py --trials 0 => --trials: expected a whole number of at least 1, got '0'.
tune two_mass --metric settling.qq => metric 'settling.qq' is unknown. Did you mean 'settling.q2'?
replay mine.py RHC => FILE (CSV file: time, what the controller is given, and the inputs
replay mine.py RHC folder.py => recording 'folder.py' cannot be read: Is a directory
replay mine.py RHC empty.csv => recording empty.csv: it is empty; expected a line of names, such as time
replay mine.py RHC words.csv => recording words.csv: line 4 is not made of numbers: 0, abc
replay mine.py RHC other.csv =>
    1. it lacks columns for angle, angle', angle'', which the controller is given; its columns are time, phi ... 2. its times are
    not 0.01 s apart, the period of the problem
replay mine.py RHC notes.txt => which the controller is given; its columns are x = 1 ... lacks a column for time
check mine.py --ignore-below -1 => --ignore-below: expected percent from 0 to below 100, such as 20%, got '-1'
accept mine.py --reason '' => say why the new numbers are right, --reason 'horizon 20 -> 30'
accept mine.py --reason x --processes -1 => --processes: expected a whole number of at least 1, got '-1'.
export mine.py RHC => --out is missing. See fpirhc export --help.
export mine.py RHC --out o --live optimiser.iterations => is a whole number or a switch
probe mine.py --amplitude -1 => expected a number of at least 0, in the unit of the signal
probe mine.py --chatter 0 => expected a number above 0, in the unit of the signal
export two_mass RHX --out o => problem 'two_mass': controller 'RHX' is unknown. Did you mean 'RHC'? Valid: 'CTC', 'CTC+FPI (eq 3)'
replay two_mass X short.csv => problem 'two_mass': controller 'X' is unknown. Valid: 'CTC', 'CTC+FPI (eq 3)'
probe two_mass --controller X => problem 'two_mass': controller 'X' is unknown. Valid: 'CTC', 'CTC+FPI (eq 3)'
lab two_mass --controllers X => problem 'two_mass': controller 'X' is unknown. Valid: 'CTC', 'CTC+FPI (eq 3)'
limits two_mass --controllers X => problem 'two_mass': controller 'X' is unknown. Valid: 'CTC', 'CTC+FPI (eq 3)'
limits two_mass --over nosuch => quantity 'nosuch' is unknown. Did you mean 'noise'? Valid: mismatch, latency,
compare two_mass --headline rmse => metric 'rmse' is unknown. Did you mean 'rms_error'? Valid: relative error,
compare two_mass --optimisers ipot => optimiser 'ipot' is unknown. Did you mean 'ipopt'? Valid: fixed-point, ipopt,
compare two_mass --cases heavy => problem 'two_mass' has no cases; add to its file cases = fpirhc.Cases({'heavy':
export two_mass RHC --to matlab --out o => the target 'matlab' is unknown. Valid: arduino, c, cortex-m, fmu, fmu2, library,
export two_mass CTC --out o --name int => 'int' cannot be the name of a controller in C: expected at most 40 letters,
new 'two mass' => 'two mass' is no name for a problem: it must begin with a letter and go on with letters, digits
new 2mass => Try 'plant_2mass'; a folder is given by --dir
list --x => the option '--x' is unknown. Valid: --help, --debug. See fpirhc list --help.
accept two_mass => --reason is missing. See fpirhc accept --help.
compare two_mass --scenarios 5 => every scenario would be the same: the problem has no disturbances, no sensor noise, and no
accept two_mass --reason x --seeds 1 => --seeds: expected a whole number of at least 2, got '1'.
export two_mass CTC --out o --cycles -3 => --cycles: expected a whole number of at least 1, got '-3'.
export two_mass CTC --out o --to fmu --check => --check is there for c, cortex-m, not for fmu
probe two_mass --cycles 3 => probe: 3 cycles are too few to tell a gain from noise; expected at least 40, 300 are usual
run two_mass RHC+FPI --set deformation.gian=-1 => (Sigmoid) has no 'gian'. Did you mean 'gain'? Valid: gain, shift, scale.
run two_mass RHC --set m1.exact=nan => --set: 'm1.exact': expected a finite number, got nan
compare two_mass --set exact.m9=1 => --set: 'exact.m9': 'exact.NAME' has a parameter of what moves, and there is no 'm9'.
run two_mass RHC --set deformation.gain=-1 =>
    setting 'deformation.gain': 'deformation' of the controller (Identity) has no 'gain'. ... It has no settings; the controller
    has settings in:
run two_mass RHC+FPI --set limits.inputs.Q3=1,2 =>
    setting 'limits.inputs.Q3': 'limits.inputs' of the problem has no 'Q3'. Did you mean 'Q2'? Valid: Q1, Q2.
run two_mass CTC --set limits.inputs.Q1=5,-5 => problem: limits: 'Q1' has lower 5.0 above upper -5.0; swap them
export two_mass CTC --out o --live gain =>
    setting 'gain': neither the controller nor the problem's cost, limits, dead_time, reference
compare two_mass --tuned notes.txt => 'notes.txt' is not a file that 'fpirhc tune' wrote
replay two_mass CTC short.csv => recording short.csv: line 2 has 1 entries, the line of names 2
probe mine.py --recording words.csv --cycles 7 =>
    cycles is of an excitation, and a recording has been excited: leave one of them out
replay mine.py RHC words.csv --out words.csv => --out words.csv is the recording itself, which would be lost
probe mine.py --recording words.csv => recording words.csv: line 4 is not made of numbers: 0, abc
"""
NOT_WRITABLE = """
new mine => 'mine.py' exists already and is kept; choose another name or --dir
compare mine.py --out notes.txt/a => cannot write to the folder 'notes.txt/a': it is a file
check mine.py --markdown gone/x.md => cannot write to 'gone/x.md': there is no folder 'gone'
accept mine.py --reason x --baselines notes.txt => notes.txt' is a file; give another folder by --baselines
compare two_mass --out notes.txt => cannot write to the folder 'notes.txt': it is a file; choose another with --out
run two_mass CTC --out notes.txt => cannot write to the folder 'notes.txt': it is a file; choose another with --out
lab two_mass --out notes.txt/lab.html => cannot write to the folder 'notes.txt': it is a file; choose another with --out
new arm --dir notes.txt => cannot write to the folder 'notes.txt': it is a file; choose another with --dir
export two_mass CTC --out folder.py --cycles 1 =>
    'folder.py' is not an empty folder, and nothing in it is replaced; choose another
"""
SAYS_NO = """
check mine.py => there is no baseline 'mine.json'; write one: fpirhc accept PROBLEM --reason ...
check nofile => nofile: cannot be run problem 'nofile' is unknown.
check . => .: cannot be run '.' is a folder; a problem file ends in .py, such as mine.py
"""


def lines(table: str, code: ExitCode | None) -> dict[str, Wrong]:
    return {
        words: Wrong(PENDULUM, (), tuple(said.split(" ... ")), tuple(shlex.split(words)), BESIDE, code)
        for words, said in messages_of(table).items()
    }


LINES = lines(REFUSED, ExitCode.BAD_INPUT) | lines(NOT_WRITABLE, ExitCode.NOT_WRITABLE) | lines(SAYS_NO, None)
WRONG = FILES | LINES


def files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_file_or_command_line_is_explained(name, tmp_path, monkeypatch, capsys):
    wrong = WRONG[name]
    monkeypatch.chdir(tmp_path)
    Path("folder.py").mkdir()
    text = wrong.file
    for old, new in wrong.changes:
        assert old in text
        text = text.replace(old, new, 1)
    for file, content in {"mine.py": text, **wrong.beside}.items():
        Path(file).write_text(content, encoding="utf-8")
    before = files(tmp_path)
    code = main(list(wrong.words))
    printed = capsys.readouterr()
    said = " ".join((printed.out + printed.err).split())
    if wrong.code is None:
        assert code in (ExitCode.BAD_INPUT, ExitCode.ANSWERED_NO, ExitCode.NO_BASELINE)
    else:
        assert (code, printed.out) == (wrong.code, "")
        assert said.startswith("fpirhc: ")
        assert files(tmp_path) == before
    assert "Traceback" not in said
    assert "an error inside" not in said
    assert "usage:" not in said
    place = -1
    for words in wrong.said:
        place = said.find(words, place + 1)
        assert place >= 0, f"'{words}' is not in its place in: {said}"


@pytest.mark.parametrize("file", [PENDULUM, REACTOR, TANKS])
def test_the_files_without_a_mistake_are_accepted(file, tmp_path):
    (tmp_path / "mine.py").write_text(file, encoding="utf-8")
    assert len(fp.load_problem(str(tmp_path / "mine.py")).controllers) == 2


def test_a_file_imports_its_neighbours_and_forgets_them(tmp_path):
    """Two folders with modules of one name, as `fpirhc check` meets them."""
    for folder, angle in (("first", 0.1), ("second", 0.2)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "numbers_of_mine.py").write_text(f"START = {angle}\n", encoding="utf-8")
        text = PENDULUM.replace("import fpirhc as fp", "import fpirhc as fp\nfrom numbers_of_mine import START", 1)
        (tmp_path / folder / "mine.py").write_text(text.replace('{"angle": 0.0}', '{"angle": START}'), encoding="utf-8")
    starts = [fp.load_problem(str(tmp_path / folder / "mine.py")).problem.start for folder in ("first", "second")]
    assert starts == [{"angle": 0.1}, {"angle": 0.2}]


def test_a_file_is_read_as_it_is_now(tmp_path, monkeypatch):
    """Also where it was changed within a second to one of the same length, and no bytecode is left beside it."""
    monkeypatch.setattr("sys.dont_write_bytecode", False)
    path, starts = tmp_path / "mine.py", []
    for angle in ("0.1", "0.2"):
        path.write_text(PENDULUM.replace('{"angle": 0.0}', f'{{"angle": {angle}}}'), encoding="utf-8")
        starts.append(fp.load_problem(str(path)).problem.start["angle"])
    assert starts == [0.1, 0.2]
    assert [file.name for file in tmp_path.iterdir()] == ["mine.py"]


def test_names_of_other_tools_lead_to_names_that_exist():
    public = [getattr(fp, name) for name in fp.__all__]
    fields = {name for one in public if isinstance(one, type) and issubclass(one, Checked) for name in field_names(one)}
    known = {*fp.__all__, *fields, *signature(fp.Plant.of_states).parameters}
    assert {ours for names in OF_OTHER_TOOLS.values() for ours in names} <= known
    assert not OF_OTHER_TOOLS.keys() & set(fp.__all__)


def test_a_long_list_of_valid_names_is_cut():
    with pytest.raises(AttributeError) as caught:
        getattr(fp, "Sigmiod")  # noqa: B009 -- the name is wrong on purpose
    said = str(caught.value)
    assert said.startswith("fpirhc has no name 'Sigmiod'. Did you mean 'Sigmoid'? Valid: Sigmoid, ")
    assert re.search(r" and \d+ more\.$", said)


@pytest.mark.parametrize(
    ("words", "said"), [(["help", "run"], "usage: fpirhc run"), (["help"], "usage: fpirhc [--help]")]
)
def test_help_is_understood_as_a_command(words, said, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith(said)


def test_a_name_that_no_file_can_have_is_bad_input(capsys):
    assert main(["compare", f"{'x' * 300}.py"]) == 2
    assert capsys.readouterr().err.endswith(".py': File name too long\n")
