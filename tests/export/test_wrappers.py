"""Controllers as parts of other tools: each wrapper answers samples as the stepper does, against headers of the test's own.

The tools are not here. Headers of the test declare what a wrapper calls, so it is the wrapper's logic that is tried, not the tool.
"""

from __future__ import annotations

import ctypes
import json
import platform
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from kinds import slow_but

import fpirhc as fp
from fpirhc.errors import InvalidValue
from fpirhc.export.device import Device
from fpirhc.export.target import device_of, target_called, write
from fpirhc.symbolic.native import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
LIVE = ("deformation.gain", "limits.inputs.Q1")
GAIN, CYCLES = -0.25, 40
CHANGE, LATER = 30, -0.3  # another gain from a cycle on


def exported(folder: Path, target: str) -> Device:
    task = fp.load_problem("two_mass")
    title = "CTC+FPI (eq 6)"
    device = device_of(task.problem, task.controllers[title], title, name="arm", live=LIVE, cycles=1)
    write(device, target_called(target), folder)
    return device


def answered(device: Device) -> tuple[np.ndarray, np.ndarray]:
    """Samples, one of them bad, and what the stepper answers to them with other gains: status and command of each cycle."""
    generator, period = np.random.default_rng(3), device.problem.period
    rows = np.tile([0.0, 1.9, 5.4, 0.0, 0.0, 0.1, -0.2], (CYCLES, 1)) + 1e-3 * generator.standard_normal((CYCLES, 7))
    rows[:, 0] = period * np.arange(CYCLES)
    rows[20, 1] = np.nan
    assert isinstance(device.stepper, fp.Stepper)
    device.stepper.change({"deformation.gain": GAIN})
    memory, answers = device.stepper.start(), []
    for k, row in enumerate(rows):
        if k == CHANGE:
            device.stepper.change({"deformation.gain": LATER})
        command, memory = device.stepper.step_measured(row[0], row[1:], memory)
        answers.append([float(device.stepper.trace()["status"].ravel()[0]), *command])
    return rows, np.array(answers)


def run(folder: Path, compiler: str, flags: list[str], files: list[str], rows: np.ndarray) -> np.ndarray:
    """The answers of a program that reads samples and prints status and command."""
    program, objects = folder / "program", []
    for source in sorted(folder.glob("arm*.c")):
        if source.name not in files:
            objects.append(str(source.with_suffix(".o")))
            subprocess.run([str(find_compiler()), "-std=c99", "-O2", "-c", str(source), "-o", objects[-1]], check=True)
    sources = [str(folder / file) for file in files]
    done = subprocess.run(
        [compiler, *flags, "-Wall", "-Wextra", "-Werror", f"-I{folder}", *sources, *objects, "-o", str(program), "-lm"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    text = "\n".join(" ".join(value.hex() for value in row) for row in rows)
    said = subprocess.run([str(program)], input=text, capture_output=True, text=True, check=True).stdout
    return np.array([[float.fromhex(word) for word in line.split()] for line in said.splitlines()])


SIMSTRUC = r"""
#include <math.h>
#include <stddef.h>
typedef double real_T; typedef int int_T; typedef struct { double value; size_t entries; } mxArray;
typedef struct {
  void* work; double period, time, *in[8], *out[2]; mxArray param[8]; int params, tunable, ports, widths[8]; const char* error;
} SimStruct;
#define ssSetNumSFcnParams(S, n) ((S)->params = (n))
#define ssGetNumSFcnParams(S) ((S)->params)
#define ssGetSFcnParamsCount(S) 3
#define ssSetSFcnParamTunable(S, k, yes) ((S)->tunable += (yes))
#define ssSetNumInputPorts(S, n) ((S)->ports = (n))
#define ssSetNumOutputPorts(S, n) ((n) == 2)
#define ssSetInputPortWidth(S, k, n) ((S)->widths[k] = (n))
#define ssSetInputPortRequiredContiguous(S, k, yes) ((void)(k))
#define ssSetInputPortDirectFeedThrough(S, k, yes) ((void)(k))
#define ssSetOutputPortWidth(S, k, n) ((void)(n))
#define ssSetNumSampleTimes(S, n) ((void)(n))
#define ssSetNumPWork(S, n) ((void)(n))
#define ssSetSampleTime(S, k, t) ((S)->period = (t))
#define ssSetOffsetTime(S, k, t) ((void)(t))
#define ssSetPWorkValue(S, k, p) ((S)->work = (p))
#define ssGetPWorkValue(S, k) ((S)->work)
static void** ssGetPWork(SimStruct* S) { return S->work ? &S->work : NULL; }
#define ssSetErrorStatus(S, text) ((S)->error = (text))
#define ssGetSFcnParam(S, k) (&(S)->param[k])
#define mxIsDouble(a) ((void)(a), 1)
#define mxIsComplex(a) ((void)(a), 0)
#define mxIsSparse(a) ((void)(a), 0)
#define mxGetNumberOfElements(a) ((a)->entries)
#define mxGetPr(a) ((a)->entries ? &(a)->value : NULL)
#define mxGetNaN() NAN
#define ssGetT(S) ((S)->time)
#define ssGetInputPortRealSignal(S, k) ((S)->in[k])
#define ssGetOutputPortRealSignal(S, k) ((S)->out[k])
"""
MODEL = r"""
#include <stdio.h>
#define ROWS 4
int main(void) {
  SimStruct S = {.param = {{-0.25, 1}, {-300, 1}, {300, 1}}};
  double in[7], out[2], status;
  int cycle = 0;
  mdlInitializeSizes(&S), mdlInitializeSampleTimes(&S), mdlStart(&S);
  if (S.tunable != 3 || S.error || S.ports != 2 || S.widths[0] != 4 || S.widths[1] != 2 || S.period != 0.001) return 1;
  S.in[0] = in + 1, S.in[1] = in + 5, S.out[0] = out, S.out[1] = &status;
  while (scanf("%la %la %la %la %la %la %la", in, in + 1, in + 2, in + 3, in + 4, in + 5, in + 6) == 7) {
    if (cycle++ == 30) {
      S.param[0].value = 3, mdlCheckParameters(&S); /* refused, and the old number stays */
      if (!S.error) return 1;
      S.error = NULL, S.param[0].value = -0.3, mdlCheckParameters(&S), mdlProcessParameters(&S);
      S.param[1].value = 350, S.param[2].value = 400, mdlCheckParameters(&S); /* above the limit of the machine */
      if (!S.error) return 1;
      S.error = NULL;
    }
    S.time = in[0];
    mdlOutputs(&S, 0), mdlOutputs(&S, 0), mdlUpdate(&S, 0); /* outputs may be asked for again */
    printf("%a %a %a\n", status, out[0], out[1]);
  }
  mdlTerminate(&S);
  S.param[0].value = 3, mdlStart(&S), mdlTerminate(&S);
  if (!S.error) return 1;
  S.error = NULL, S.param[0].entries = 0, mdlStart(&S), mdlTerminate(&S); /* the parameter is [] */
  return S.error == NULL;
}
"""


@needs_compiler
def test_an_s_function_answers_as_the_stepper_bit_by_bit(tmp_path):
    """Outputs twice in a sample, as Simulink may ask; a gain outside its bounds, or none, is an error of the block."""
    device = exported(tmp_path, "simulink")
    (tmp_path / "simstruc.h").write_text(SIMSTRUC)
    (tmp_path / "cg_sfun.h").write_text(MODEL)
    rows, answers = answered(device)
    np.testing.assert_array_equal(run(tmp_path, str(find_compiler()), ["-std=c99"], ["arm_sfun.c"], rows), answers)
    text = (tmp_path / "arm_sfun.c").read_text()
    assert "Input ports, in this order: state (q1, q2, q1', q2'); realised (q1, q2)." in text
    assert "Parameters of the block, in this order: deformation.gain, limits.inputs.Q1.0, limits.inputs.Q1.1." in text


ROS = {
    "rclcpp/rclcpp.hpp": r"""
#pragma once
#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>
namespace rcl_interfaces::msg { struct SetParametersResult { bool successful = false; std::string reason; }; }
namespace rclcpp {
struct Duration { double value; double seconds() const { return value; } };
struct Time { double value = 0; };
inline Duration operator-(Time a, Time b) { return {a.value - b.value}; }
struct Parameter { std::string name; double number; std::vector<std::string> texts = {};
  const std::string& get_name() const { return name; }
  std::vector<std::string> as_string_array() const { return texts; } double as_double() const { return number; } };
struct Logger {};
struct Handle { using SharedPtr = std::shared_ptr<Handle>; };
namespace node_interfaces { using OnSetParametersCallbackHandle = Handle; }
struct Node { std::map<std::string, Parameter> all;
  std::function<rcl_interfaces::msg::SetParametersResult(const std::vector<Parameter>&)> asked;
  template <class F> Handle::SharedPtr add_on_set_parameters_callback(F f) {
    asked = f; return std::make_shared<Handle>(); }
  Parameter get_parameter(const std::string& name) const { return all.at(name); } Logger get_logger() const { return {}; } };
}
#define RCLCPP_ERROR(logger, ...) ((void)(logger), std::fprintf(stderr, __VA_ARGS__))
""",
    "rclcpp_lifecycle/state.hpp": "#pragma once\nnamespace rclcpp_lifecycle { struct State {}; }\n",
    "pluginlib/class_list_macros.hpp": '#define PLUGINLIB_EXPORT_CLASS(type, base) static_assert(true, "");\n',
    "controller_interface/controller_interface.hpp": r"""
#pragma once
#include <cmath>
#include <optional>
#include <type_traits>
#include <rclcpp/rclcpp.hpp>
#include <rclcpp_lifecycle/state.hpp>
namespace controller_interface {
enum class CallbackReturn { SUCCESS, ERROR };
enum class return_type { OK, ERROR };
enum class interface_configuration_type { INDIVIDUAL };
struct InterfaceConfiguration { interface_configuration_type type; std::vector<std::string> names; };
INTERFACE
struct ControllerInterface {
  virtual ~ControllerInterface() = default;
  virtual CallbackReturn on_init() = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State&) = 0;
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State&) = 0;
  virtual return_type update(const rclcpp::Time&, const rclcpp::Duration&) = 0;
  std::shared_ptr<rclcpp::Node> get_node() const { return node; }
  unsigned get_update_rate() const { return rate; }
  template <class T> void auto_declare(const std::string& name, const T& value) { put(name, value); }
  void put(const std::string& name, const std::vector<std::string>& value) { node->all[name] = {name, 0, value}; }
  void put(const std::string& name, double value) { node->all[name] = {name, value, {}}; }
  std::shared_ptr<rclcpp::Node> node = std::make_shared<rclcpp::Node>();
  unsigned rate = 1000;
  std::vector<Interface> state_interfaces_, command_interfaces_;
};
}
""",
}
# Numbers of interfaces as in ROS 2 Humble, and as from Jazzy on, where another thread may hold them.
INTERFACES = {
    "humble": "struct Interface { double value = 0; bool held = false; double get_value() const { return held ? 0 / 0. : value; } "
    "void set_value(double v) { value = v; } };",
    "jazzy": """struct Interface { double value = 0; bool held = false;
  template <typename T = double> [[nodiscard]] std::optional<T> get_optional(unsigned = 10) const {
    return held ? std::nullopt : std::optional<T>(value); }
  template <typename T> [[nodiscard]] bool set_value(const T& v, unsigned = 10) { if (!held) value = v; return !held; } };""",
}
MANAGER = r"""
#include "arm_controller.cpp"
int main() {
  using Back = controller_interface::CallbackReturn;
  arm_ros::Controller c;
  if (c.on_init() != Back::SUCCESS) return 1;
  std::string names;
  for (const auto& one : c.state_interface_configuration().names) names += one + " ";
  if (names != "q1/position q2/position q1/velocity q2/velocity q1/acceleration q2/acceleration ") return 2;
  if (c.command_interface_configuration().names[1] != "Q2/effort") return 3;
  c.rate = 500;
  if (c.on_configure({}) != Back::ERROR) return 4;
  c.rate = 1000, c.put("deformation.gain", 3.0);
  if (c.on_configure({}) != Back::ERROR) return 5;
  c.put("deformation.gain", -0.25);
  if (c.on_configure({}) != Back::SUCCESS || c.on_activate({}) != Back::SUCCESS) return 6;
  c.state_interfaces_.resize(6), c.command_interfaces_.resize(2);
  double in[7];
  int cycle = 0;
  while (std::scanf("%la %la %la %la %la %la %la", in, in + 1, in + 2, in + 3, in + 4, in + 5, in + 6) == 7) {
    if (cycle++ == 30) {
      if (c.node->asked({{"deformation.gain", -0.3}, {"limits.inputs.Q1.0", 400.0}}).successful) return 9; /* all or none */
      if (!c.node->asked({{"deformation.gain", -0.3}, {"another", 0.0}}).successful) return 10;
    }
    for (int k = 0; k < 6; ++k) c.state_interfaces_[k].value = in[k + 1];
    c.state_interfaces_[0].held = std::isnan(in[1]);
    if (c.update(rclcpp::Time{in[0]}, rclcpp::Duration{0.001}) != controller_interface::return_type::OK) return 7;
    std::printf("%a %a %a\n", double(c.status()), c.command_interfaces_[0].value, c.command_interfaces_[1].value);
  }
  if (std::is_same_v<decltype(c.command_interfaces_[0].set_value(0.0)), bool>) { /* a command that is not taken is an error */
    c.command_interfaces_[1].held = true;
    if (c.update(rclcpp::Time{in[0] + 0.001}, rclcpp::Duration{0.001}) == controller_interface::return_type::OK) return 8;
  }
}
"""


@needs_compiler
@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++")
@pytest.mark.parametrize("release", slow_but(INTERFACES, list(INTERFACES)[-1]))
def test_a_plugin_of_ros2_control_answers_as_the_stepper_bit_by_bit(release, tmp_path):
    """Names of interfaces, a rate that is not the period's, a gain outside its bounds, a number that another thread holds."""
    device = exported(tmp_path, "ros2_control")
    for file, text in ROS.items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(text.replace("INTERFACE\n", f"{INTERFACES[release]}\n"))
    (tmp_path / "main.cpp").write_text(MANAGER)
    rows, answers = answered(device)
    said = run(tmp_path, "g++", ["-std=c++17", "-pedantic"], ["main.cpp"], rows)
    np.testing.assert_array_equal(said, answers)
    assert 'type="arm_ros::Controller"' in (tmp_path / "arm_plugin.xml").read_text()


def test_a_plant_whose_time_is_in_years_has_no_plugin(tmp_path):
    task = fp.load_problem("fishery")
    device = device_of(task.problem, task.controllers["RHC+FPI"], "RHC+FPI", cycles=1)
    with pytest.raises(
        InvalidValue,
        match=r"ros2_control runs in real time: a period in s, us, ms, min, h, day was expected, got one in",
    ):
        write(device, target_called("ros2_control"), tmp_path / "out")


@pytest.mark.parametrize(
    ("period", "unit", "paced"),
    [
        (1e-3, "s", ("TICKS = 1000;", "#define TICKS 1UL\n#define TICK 0.001")),
        (2.5e-3, "s", ("TICKS = 2500;", "#define TICKS 3UL\n#define TICK 0.0008333333333333334")),
        (0.5, "ms", ("TICKS = 500;", "#define TICKS 1UL\n#define TICK 0.0005")),
        (0.05, "min", ("TICKS = 3000000;", "#define TICKS 3000UL\n#define TICK 0.001")),
        (0.1, "year", ('#error "the period is in year', '#error "the period is in year')),
    ],
)
def test_examples_for_boards_keep_the_pace_of_the_controller(period, unit, paced, monkeypatch):
    """An Arduino counts microseconds, and the system tick of a Cortex-M whole shares of a period, of at most a millisecond."""
    monkeypatch.setattr("fpirhc.export.targets.cortex_m.arm_programs", lambda *_: ({}, {}))
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    plant = fp.Plant(
        coordinates={"x": "m"},
        inputs={"F": "N"},
        order=2,
        response=lambda q, v, u, p: {"x": u.F / p.m},
        parameters={"m": fp.Parameter(1.2, 1.0, "kg")},
        time_unit=unit,
    )
    problem = fp.Problem(
        plant, fp.Trajectory(lambda t: {"x": 0 * t}), start={"x": 0.1}, period=period, duration=5 * period
    )
    device = device_of(problem, fp.ComputedTorque(fp.Exponential(0.1 / period)), "CTC", name="arm", cycles=1)
    arduino, cortex = (target_called(one).files(device) for one in ("arduino", "cortex-m"))
    assert paced[0] in str(arduino["examples/arm/arm.ino"])
    assert paced[1] in str(cortex["example.c"])


@needs_compiler
def test_a_library_answers_as_the_stepper_bit_by_bit(tmp_path):
    """Arrays in and out by ctypes, two controllers side by side, a setting by its number."""
    device = exported(tmp_path, "library")
    [path] = [p for p in tmp_path.glob("arm_*.so") if platform.machine() in p.name] or [None]
    if path is None:
        pytest.skip("no library for this platform")
    called = ctypes.CDLL(str(path))
    first, other = (ctypes.create_string_buffer(called.arm_size()) for _ in range(2))
    called.arm_begin(first), called.arm_begin(other)
    settings = list(json.loads((tmp_path / "layout.json").read_text())["bounds"])
    assert called.arm_change(first, settings.index("deformation.gain"), ctypes.c_double(3.0)) == 0
    assert called.arm_change(first, 99, ctypes.c_double(GAIN)) == 0
    assert called.arm_change(first, settings.index("deformation.gain"), ctypes.c_double(GAIN)) == 1
    rows, answers = answered(device)
    command, said, apart = (ctypes.c_double * 2)(), [], False
    for k, row in enumerate(rows):
        if k == CHANGE:
            assert called.arm_change(first, settings.index("deformation.gain"), ctypes.c_double(LATER)) == 1
        sample = (ctypes.c_double * 7)(*row)
        called.arm_cycle(other, sample, command)
        before = list(command)
        said.append([called.arm_cycle(first, sample, command), *command])
        apart |= list(command) != before
    np.testing.assert_array_equal(np.array(said), answers)
    assert apart
