"""Wrong files and command lines as they are written by people who come from other tools: what each message must say.

Each case changes a correct file (`first_files`) and runs a command on it. The message names what is wrong, where, what was
expected, and a fix; all mistakes of one file stand in it; the exit code is that of bad input, or of a review that answers no.
"""

import re
import shlex
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from helpers.first_files import PENDULUM, REACTOR, changes_of, messages_of

import fpirhc as fp
from fpirhc.__main__ import main

REVIEW = ("review", "mine.py")
BESIDE = {
    "notes.txt": "x = 1\n",
    "a_mess.py": "1 / 0\n",
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
        code: of the exit; None: a review says no, or the file is refused.
    """

    file: str
    changes: tuple[tuple[str, str], ...]
    said: tuple[str, ...]
    words: tuple[str, ...] = REVIEW
    beside: dict[str, str] = field(default_factory=dict)
    code: int | None = None


# Changes of a correct file: the name of the mistake, the old piece and the new one, and what must be said, in this order.
WRONG_PENDULUM = """
a number with its unit
  period=1e-2 -> period="10 ms"
    Problem.period: expected a number from 1e-12 to 1e12 in the plant's unit of time, got the text '10 ms'
one end of a limit
  "torque": (-15.0, 15.0) -> "torque": 15.0
    Limits.inputs['torque']: expected (a number, a number), got 15.0
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
parameters as numbers
  fp.Parameter(approximate=1.4, exact=1.0, unit="kg") -> 1.4
  fp.Parameter(approximate=0.5, exact=0.6, unit="m") -> (0.5, 0.6)
    ['mass']: expected a Parameter, got 1.4; write fp.Parameter(approximate=..., exact=..., unit=...) ... ['length']: expected a
    Parameter
unit in front
  fp.Parameter(approximate=1.4, exact=1.0, unit="kg") -> fp.Parameter("kg", 1.0, 1.4)
    mine.py, line 18 ... the values of 'approximate' and 'unit' are swapped; write Parameter(approximate=..., unit=...)
unit as a name
  {"angle": "rad"} -> {"rad": "angle"}
    line 9): coordinate 'angle' is unknown. Valid: rad.
entries by number
  q.angle -> q[0]
    line 9): coordinate '0' is unknown. Entries have names, such as .angle, no numbers.
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
limits of unknown names
  fp.Limits(inputs={"torque": (-15.0, 15.0)}) -> fp.Limits(inputs={"tau": (-15.0, 15.0)}, states={"angle_dot": (-3, 3)})
    input 'tau' is unknown. Valid: torque. ... state 'angle_dot' is unknown. Did you mean "angle'"?
cost as a function
  fp.Quadratic(states={"angle": 1e3, "angle'": 1.0}, deviation={"torque": 1e-2}) -> lambda x, u: x[0] ** 2
    Problem.cost: expected a Cost or None, got the function <lambda>(x, u); one of CustomCost, Quadratic
cost of an unknown member
  fp.Quadratic(states={"angle": 1e3, "angle'": 1.0}, deviation={"torque": 1e-2}) -> fp.CustomCost(lambda v: {"e": v.x.angle**2})
    line 31): a View has no 'x' ... Valid: state, reference, input
reference without a function
  fp.Trajectory(lambda t: {"angle": 0.8 * ca.sin(2 * t)}) -> fp.Trajectory({"angle": 0.8})
    mine.py, line 25 ... expected a function of 1 argument, got {'angle': 0.8}
reference that is not finite
  0.8 * ca.sin(2 * t) -> ca.sqrt(t)
    mine.py, line 23 ... reference: at t = 0 s angle' is inf, angle'' is -inf ... give a motion that has these values
an input that is switched
  u.torque - p.friction -> ca.if_else(u.torque > 0.5, 1, 0) - p.friction
    input 'torque' has no independent effect there ... In a switch (if_else, floor, sign) it has no slope: write its mean
response that divides by zero
  ca.sin(q.angle) -> ca.sin(q.angle) / q.angle
    the response of 'angle' (approximate parameters) is not finite at the start (angle = 0, angle' = 0) ... start elsewhere, or
    mend a root or a division in mine.py, line 7
a module that is not imported
  ca.sin(q.angle) -> math.sin(q.angle)
    response (mine.py, line 9): 'math' is not imported; write import math at the top of the file
another order
  order=2, -> order=1,
    with order 1 it is called as response(q, u, p); response(q, v, u, p) is that of Plant(..., order=2)
disturbance without a name
  measure_from=0.05 -> disturbances=fp.Step(0.1, 1.0)
    expected {name: a Disturbance}, got a value of the class Step; write {'NAME': Step(...)} with the name of what it belongs to
class of another tool
  {"RHC": fp.RecedingHorizon(optimiser), "RHC+FPI": fp.RecedingHorizon(optimiser, adaptive)} -> {"MPC": fp.MPC(optimiser)}
    fpirhc has no name 'MPC'. Did you mean 'RecedingHorizon'? ... more.
start outside the limits
  fp.Limits(inputs={"torque": (-15.0, 15.0)}) -> fp.Limits(inputs={"torque": (-15.0, 15.0)}, states={"angle": (0.5, 2.5)})
    no Do start and reference keep the hard limits of states? ... The start of angle is 0 rad, outside its hard limits of 0.5
gain of the wrong sign
  gain=-2.6 -> gain=2.6
    no Is the gain admissible? ... Set deformation.gain to -
controlled by one name
  order=2, -> order=2, controlled="angle",
    Plant.controlled: expected (a text, ...) or None, got the text 'angle'; write ('angle',)
a search in the cost of the problem
  controllers = { -> tuning = {"RHC": {"cost.deviation.torque": fp.LogSpan(1e-3, 1.0)}}; controllers = {
    setting 'cost.deviation.torque' is the problem's; ... changes controllers alone; give this one its own, cost=problem.cost
headline of no pair
  controllers = { -> headline = ("RHC+FPI", "RHC"); controllers = {
    headline ('RHC+FPI', 'RHC') is no pair of a controller and the same one with adaptation: ('RHC', 'RHC+FPI')
headline of two that differ in a setting
  controllers = {"RHC": fp.RecedingHorizon(optimiser -> headline = ("RHC", "RHC+FPI"); controllers = {"RHC": fp.RecedingHorizon(plan
  optimiser = fp -> plan = fp.FixedPointSolver(); optimiser = fp
    same one with adaptation: "iterations": null against "iterations": 1; none is here, so leave headline out
controllers under another name
  controllers = { -> controller = {
    'controller' is one, so call it 'controllers'
parenthesis that stays open
  reference=fp.Trajectory(lambda t: {"angle": 0.8 * ca.sin(2 * t)}), ->
      reference=fp.Trajectory(lambda t: {"angle": 0.8 * ca.sin(2 * t)},
    mine.py, line 23: '(' was never closed problem = fp.Problem(
no input in the response
  u.torque - p ->  - p
    no input reaches coordinate 'angle' ... use torque in the response
two inputs for one coordinate
  {"torque": "N m"} -> {"torque": "N m", "brake": "N m"}
  u.torque - p -> u.torque - u.brake - p
    2 inputs (torque, brake) for 1 of the coordinates (angle): each input holds one ... leave an input out ... docs/plants.md
a horizon that is not there
  horizon=fp.Horizon(stages=6, step=2e-2), ->
    no Does the controller fit the problem? -> RecedingHorizon needs Problem(horizon=...), which this problem does not have
mistakes all over the file
  import numpy as np -> import numpy as np; import do_mpc_
  unit="kg" -> units="kg"
  exact=0.6 -> exact="0.6"
  period=1e-2 -> period="1e-2"
  stages=6 -> n_horizon=6
  gain=-2.6 -> gain="big"
    line 3: import numpy as np; import do_mpc_ ModuleNotFoundError: No module named 'do_mpc_'
key that is not there
  optimiser = fp -> n = {}['max_iter']; optimiser = fp
    mine.py, line 34: n = {}['max_iter'] ... KeyError: 'max_iter'
data that are not there
  optimiser = fp -> table = np.loadtxt("gone.csv"); optimiser = fp
    line 34: table = np.loadtxt ... gone.csv not found
everything in a function
  problem = fp.Problem( -> def main(): problem = fp.Problem(
    it must define problem = fpirhc.Problem(...), outside every function
"""
WRONG_REACTOR = """
rates of time
  def rates(x, u, p) -> def rates(t, x, u, p)
    rates takes 4 arguments (mine.py, line 7); it is called as rates(x, u, p)
output of the state alone
  lambda x, p: x.T -> lambda x: x.T
    called as function(x, p) ... got the function <lambda>(x); write lambda x, p: ...
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
OTHERS = {
    f"a neighbour, {words}": Wrong(
        PENDULUM,
        (("import fpirhc as fp", "import fpirhc as fp\nfrom helper import LENGTH"),),
        ("mine.py, line 5", words),
        beside={"helper.py": text},
    )
    for text, words in (
        ("from mine import response\nLENGTH = 1.0\n", "circular import"),
        ("LENGHT = 1.0\n", "ImportError: cannot import name 'LENGTH' from 'helper'"),
    )
} | {
    "equations of MATLAB": Wrong("function dx = f(t, x)\n", (), ("mine.py, line 1: invalid syntax",)),
    "nothing": Wrong("", (), ("it must define problem = fpirhc.Problem(...)", "it must define controllers = {")),
}


def changed(file: str, table: str) -> dict[str, Wrong]:
    return {name: Wrong(file, tuple(changes), said) for name, (changes, said) in changes_of(table).items()}


FILES = changed(PENDULUM, WRONG_PENDULUM) | changed(REACTOR, WRONG_REACTOR) | OTHERS
# Command lines beside a correct file: the words, and what must be said, in this order.
REFUSED = """
compare nofile => problem 'nofile' is unknown. Problem files there: mine.py. Give the path of a problem file
compare mien.py => no file at 'mien.py'. Did you mean 'mine.py'?
compare mine => problem 'mine' is unknown. Did you mean 'mine.py'?
compare Two_Mass => Did you mean 'two_mass'?
compare . => '.' is a folder; a problem file ends in .py; it has 1, such as mine.py
mine.py => the command 'mine.py' is unknown. Write fpirhc compare mine.py.
reveiw mine.py => Did you mean 'review'?
--verion => the option '--verion' is unknown. Did you mean '--version'? ... See fpirhc --help
compare => PROBLEM ... See fpirhc compare --help
run mine.py => CONTROLLER ... See fpirhc run --help
compare mine.py --seed abc => '--seed' ... integer
compare mine.py two_mass => unexpected extra argument ... two_mass
compare mine.py --controllers RHC,RHC+FPI => controller 'RHC,RHC+FPI' is unknown ... names are separated by spaces, without commas
study mine.py --draws 2 --mismatch x => expected percent of at least 0, such as 20%, got 'x'
study mine.py --margins noise --mismatch 20 => --mismatch is of drawn plants: give --draws N too
review mine.py --mismatch 120% => mismatch 120 %: use at least 0 % and less than 100 %, where no parameter changes its sign
run mine.py fpi => controller 'fpi' is unknown. Did you mean 'RHC+FPI'?
compare mine.py --set gain=-2 => has no 'gain'. Did you mean 'optimiser.gain' or 'deformation.gain'?
run mine.py RHC --set mass=2 => write exact.mass for the plant, approximate.mass for the model
new ../my-arm => '../my-arm' is no name for a problem ... Try 'my_arm'; a folder is given by --dir
new two_mass => 'two_mass' cannot be the name of a problem: a shipped problem has it ... Try 'my_two_mass'
new numpy => a module of that name is installed, which the file would hide from everything beside it.
review mine.py --controllers => '--controllers' requires an argument
review mine.py --controllers RCH abc =>
    1. controller 'RCH' is unknown. Did you mean 'RHC'? ... 2. controller 'abc' is unknown. Valid: RHC, RHC+FPI.
study mine.py --draws 2 --metric rms_error => has a number for every coordinate; give one: rms_error.angle
study mine.py --draws 2 --metric '' => metric '' is unknown. Valid: relative error, cycles, rms_error
study mine.py --over deformation.map.gain=1:2 => expected PATH=LOW:HIGH:COUNT
study mine.py --over deformation.map.gian=1:2:3 => has no 'gian'. Did you mean 'gain'?
run mine.py RHC+FPI --set deformation.map.gain=nan => expected a finite number other than zero ... got nan
run mine.py RHC --set limits.inputs.torque=5 => Limits.inputs['torque']: expected (a number, a number), got 5.0
compare mine.py --set exact.mass=-1 => In the model mass is -1.4 times the plant's. Mend mass of the model: is it a slip of sign?
run mine.py RHC --set period=5 => or a period of ... is 5 ms meant?
run mine.py RHC --set dead_time.measurement=50 => more than 1000 control cycles ... is one of the two in ms?
run mine.py RHC --case adult => problem 'mine' has no cases; add cases = fpirhc.Cases({...}) to its file
tune mine.py => no search space ... add to its file, for example, tuning =
tune two_mass --trials 10000000000 => '--trials'
tune two_mass --metric settling.qq => metric 'settling.qq' is unknown. Did you mean 'settling.q2'?
accept mine.py --reason '' => say why the new numbers are right
export two_mass RHC --to matlab => the target 'matlab' is unknown; one of arduino, c, fmu2, library, wasm, lab
export two_mass CTC --name int => 'int' cannot be the name of a controller in C: expected at most 40 letters,
export two_mass CTC --live gain =>
    setting 'gain': neither the controller nor the problem's cost, limits, reference
probe mine.py --chatter 0 => expected a number above 0, in the unit of the signal
probe two_mass --cycles 3 => probe: 3 cycles are too few to tell a gain from noise; expected at least 40, 300 are usual
probe mine.py --recording words.csv => recording words.csv ... abc
probe mine.py --recording /dev/null => recording /dev/null: expected a line of names
run two_mass RHC --set deformation.gain=-1 =>
    setting 'deformation.gain': 'deformation' of the controller (Identity) has no 'gain'. ... It has no settings; the controller
    has settings in:
run two_mass RHC+FPI --set limits.inputs.Q3=1,2 =>
    setting 'limits.inputs.Q3': 'limits.inputs' of the problem has no 'Q3'. Did you mean 'Q2'? Valid: Q1, Q2.
"""
NOT_WRITABLE = """
new mine => 'mine.py' exists already and is kept; choose another name or --dir
compare mine.py --out notes.txt/a => cannot write to the folder 'notes.txt/a': it is a file
accept mine.py --reason x --baselines notes.txt => cannot write to the folder 'notes.txt' ... choose another with --baselines
compare two_mass --out notes.txt => cannot write to the folder 'notes.txt': it is a file; choose another with --out
new arm --dir notes.txt => cannot write to the folder 'notes.txt': it is a file; choose another with --dir
"""
NO_BASELINE = """
check mine.py => there is no baseline 'mine.json'; write one: fpirhc accept mine.py --reason
"""


def lines(table: str, code: int) -> dict[str, Wrong]:
    return {
        words: Wrong(PENDULUM, (), tuple(said.split(" ... ")), tuple(shlex.split(words)), BESIDE, code)
        for words, said in messages_of(table).items()
    }


LINES = lines(REFUSED, 2) | lines(NOT_WRITABLE, 3) | lines(NO_BASELINE, 6)
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
        assert code in (1, 2)
    else:
        assert code == wrong.code
        assert files(tmp_path) == before
    assert "Traceback" not in said
    assert "an error inside" not in said
    assert "usage:" not in said
    place = -1
    for words in wrong.said:
        place = said.find(words, place + 1)
        assert place >= 0, f"'{words}' is not in its place in: {said}"


@pytest.mark.parametrize("file", [PENDULUM, REACTOR])
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


def test_a_long_list_of_valid_names_is_cut():
    with pytest.raises(AttributeError) as caught:
        getattr(fp, "Sigmiod")  # noqa: B009 -- the name is wrong on purpose
    said = str(caught.value)
    assert said.startswith("fpirhc has no name 'Sigmiod'. Did you mean 'Sigmoid'? Valid: Sigmoid, ")
    assert re.search(r" and \d+ more\.$", said)


@pytest.mark.parametrize("mistake", ["raise RuntimeError('the drive is not armed')", "fp.Parameter(order=3)", "1 / 0"])
def test_a_file_is_executed_once_and_not_beyond_its_first_mistake(mistake, tmp_path, capsys):
    """What stands behind a guard is not reached, by no command."""
    log = tmp_path / "log"
    note = (
        f"import pathlib; log = pathlib.Path({str(log)!r}); log.write_text((log.read_text() if log.exists() else '') + "
    )
    text = f"import fpirhc as fp\n{note}'before ')\n{mistake}\n{note}'behind ')\n"
    (tmp_path / "armed.py").write_text(text, encoding="utf-8")
    for count, command in enumerate(("compare", "review", "check"), 1):
        assert main([command, str(tmp_path / "armed.py")]) == 2
        assert "armed.py, line 3: " in capsys.readouterr().err
        assert log.read_text() == count * "before "
