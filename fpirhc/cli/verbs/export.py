"""`fpirhc export PROBLEM CONTROLLER --to TARGET --out FOLDER`: a controller out of Python."""

from __future__ import annotations

import argparse
from pathlib import Path

from fpirhc.cli.options import add_controller, add_problem, whole
from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    add_controller(parser)
    parser.add_argument(
        "--to",
        metavar="TARGET",
        default="c",
        help="c: C99 for every compiler (default); cortex-m: boards; library: LabVIEW, MATLAB, ctypes; simulink: S-function; "
        "ros2_control: plugin; arduino: a library of the Arduino IDE; fmu, fmu2: units for other simulators; wasm: web pages",
    )
    parser.add_argument("--out", metavar="FOLDER", required=True, help="folder for the files, new or empty")
    text = "prefix of everything in C (default: made of the names of problem and controller)"
    parser.add_argument("--name", metavar="NAME", help=text)
    text = "settings that stay open, such as deformation.gain or limits.inputs.Q1; all others are constants"
    parser.add_argument("--live", nargs="+", default=[], metavar="PATH", help=text)
    text = "exp, sin, pow and the like: of the machine, or own ones with the same bits everywhere (default: by target)"
    parser.add_argument("--libm", choices=("system", "own"), help=text)
    text = "cycles that are recorded for the replay, faults among them (default: 2000)"
    parser.add_argument("--cycles", type=whole(1), default=2000, metavar="N", help=text)
    text = (
        "the controller alone, for the smallest boards: no gate, so a bad sample stays in its memory; no watch; missed cycles "
        "are not made up for; no live settings"
    )
    parser.add_argument("--bare", action="store_true", help=text)
    text = "build what was exported, here or for an emulated Cortex-M7, run the plant with it, and say how far apart the runs are"
    parser.add_argument("--check", action="store_true", help=text)
    text = "write misra.md too: where the C deviates from MISRA C:2012 and why, by cppcheck, in minutes"
    parser.add_argument("--misra", action="store_true", help=text)


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.export.footprint import bytes_here, worst_case
    from fpirhc.export.misra import checker, report
    from fpirhc.export.target import device_of, in_the_loop, processor_of, target_called, write
    from fpirhc.problem_files.problem_file import load_problem
    from fpirhc.studies.comparison.compare import select
    from fpirhc.whole_file import write_whole

    target = target_called(options.to)
    if options.check:
        processor_of(target)
    if options.misra:
        checker()
    task = load_problem(options.problem)
    controller = select(task, [options.controller])[options.controller]
    device = device_of(
        task.problem,
        controller,
        options.controller,
        name=options.name,
        live=options.live,
        cycles=options.cycles,
        libm=options.libm or target.libm,
        bare=options.bare,
    )
    for file in write(device, target, Path(options.out)):
        print(f"wrote {file}")
    if options.misra:
        page = Path(options.out) / "misra.md"
        write_whole(report(device), page, "MISRA report")
        print(f"wrote {page}")
    sizes = {"memory": device.stepper.memory.size, "trace": device.stepper.signals.size, "work": device.sizes["w"]}
    print(f"numbers of one controller: {', '.join(f'{size} of {what}' for what, size in sizes.items())}")
    print(f"worst case: {worst_case(device)}")
    sizes_of_target = Path(options.out) / target.told
    print(sizes_of_target.read_text(encoding="utf-8") if target.told else bytes_here(device), end="")
    if options.bare:
        print(
            "bare: no sample is checked; one that is no number stays in the memory until the next reset. Missed cycles are not "
            "made up for, and no failure is watched for"
        )
    for path, (low, high) in device.bounds.items():
        print(f"setting {path}: from {low:.6g} to {high:.6g}, now {device.stepper.numbers[path]:.6g}")
    if options.check:
        cycles, apart = in_the_loop(device, target, Path(options.out))
        print(
            f"in the loop: {cycles} cycles, commands within {apart:.1g} of those of this run (relative to the largest one)"
        )
    return ExitCode.FINISHED


VERB = Verb(
    name="export",
    summary="write a controller for a device or another simulator: without Python, bit by bit the same",
    add=_add,
    run=_run,
    codes={ExitCode.NOT_WRITABLE: "the folder is not empty, or cannot be written"},
    examples=(
        ('fpirhc export two_mass "RHC+FPI" --out device', "C99 in the folder device"),
        ('fpirhc export two_mass "RHC+FPI" --out device --name arm', "arm_init, arm_step, arm_reset"),
        (
            'fpirhc export two_mass "CTC+FPI (eq 6)" --out device --live deformation.gain limits.inputs.Q1',
            "and arm_set, which refuses numbers outside their bounds",
        ),
        (
            'fpirhc export two_mass "RHC+FPI" --to cortex-m --out board --check',
            "libraries, and a run in an emulated board",
        ),
        (
            'fpirhc export two_mass "CTC+FPI (eq 6)" --to arduino --bare --out uno',
            "a library for the Arduino IDE, as small as it gets",
        ),
        ('fpirhc export two_mass "RHC+FPI" --to fmu --out device', "an FMI 3.0 unit for co-simulation"),
        ('fpirhc export two_mass "RHC+FPI" --to wasm --out web', "WebAssembly with a wrapper in JavaScript"),
    ),
    notes="""
Where there is a compiler, recorded cycles with faults are compared bit by bit:

  cmake -S device -B build && cmake --build build && build/replay device/samples.bin

A compiler is not needed to write C. Nothing is allocated: the caller owns one struct per controller. What needs a solver's own
library (IPOPT, fatrop, OSQP) is refused. With fused multiply-add (-ffp-contract=fast) numbers differ in their last digits.
""",
)
