"""Write docs/targets.md: what exported controllers need and how they answer, by the compilers, FMPy, Node and emulators here."""

from __future__ import annotations

import argparse
import gzip
import hashlib
import io
import re
import struct
import subprocess
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import fpirhc as fp
from fpirhc.errors import NotSupported
from fpirhc.export.binaries import WEB_STACK
from fpirhc.export.cortex import Board, Image
from fpirhc.export.footprint import deepest, said_by_gcc
from fpirhc.export.misra import deviations, reasons
from fpirhc.export.target import device_of, processor_of, target_called, write
from fpirhc.export.targets.c import sources
from fpirhc.symbolic.native import find_compiler

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from uno import answered

PAGE = Path(__file__).resolve().parents[1] / "docs" / "targets.md"
Limited = dict[str, tuple[float, float]]
CASES: tuple[tuple[str, str, Limited], ...] = (
    ("two_mass", "CTC+FPI (eq 6)", {}),
    ("two_mass", "RHC+FPI", {}),
    ("two_mass", "RHC+FPI", {"q1": (1.85, 2.35)}),
    ("anaesthesia", "RHC+FPI", {}),
    ("fishery", "RHC+FPI", {}),
    ("noisy_motor", "RHC+FPI", {}),
    ("leaking_tanks", "RHC+FPI", {}),
)
PLAIN = tuple(case[:2] for case in CASES if not case[2])
SMALL = (
    ("two_mass", "CTC+FPI (eq 6)"),
    ("anaesthesia", "CTC+FPI"),
    ("fishery", "CTC+FPI"),
    ("noisy_motor", "RHC+FPI"),
    ("leaking_tanks", "RHC+FPI"),
    ("fishery", "RHC+FPI"),
    ("two_mass", "RHC+FPI"),
)
CYCLES = 2000
PROCESSORS = {"Uno": "atmega328p", "Mega 2560": "atmega2560"}
QEMU = (
    "qemu-system-arm", "-display", "none", "-serial", "none", "-monitor", "none",
    "-semihosting-config", "enable=on,target=native", "-kernel",
)  # fmt: skip


def row(problem: str, title: str, states: Limited) -> list[str]:
    """One line of the table."""
    task, compiler = fp.load_problem(problem), str(find_compiler())
    device = device_of(_limited(task.problem, states), task.controllers[title], title, name="c", cycles=CYCLES)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(device, target_called("c"), folder)
        sources = sorted(folder.glob("c*.c"))
        objects = [str(path.with_suffix(".o")) for path in sources]
        for source, made in zip(sources, objects, strict=True):
            strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Os", "-fstack-usage"]
            subprocess.run([compiler, *strict, "-c", str(source), "-o", made], check=True)
        flash = sum(int(line.split()[0]) for line in _said("size", *objects).splitlines()[1:])
        stack = deepest(said_by_gcc(folder), "c")
        program = folder / "replay"
        files = [*map(str, sources), str(folder / "main.c")]
        subprocess.run([compiler, "-std=c99", "-O2", *files, "-o", str(program), "-lm"], check=True)
        said = _said(str(program), str(folder / "samples.bin"))
        counted = _counted(str(program), str(folder / "samples.bin"))
        differ = re.search(r"command (\d+), memory (\d+), trace (\d+)", said)
        size = re.search(r"(\d+) bytes of a controller", said)
        assert differ is not None
        assert size is not None
        samples = (folder / "samples.bin").read_bytes()
    digest = hashlib.sha256(samples).hexdigest()[:12]
    sums = " / ".join(differ.groups())
    memory, work = device.stepper.memory.size, device.sizes["w"]
    return [_called(problem, title, states), f"{flash / 1000:.1f}", f"{int(size[1]) / 1000:.1f}", f"{stack / 1000:.1f}",
            f"{memory}", f"{work}", f"{counted / CYCLES:.0f}", sums, digest]  # fmt: skip


def _counted(*program: str) -> int:
    """Instructions in all steps of a replay, by Callgrind."""
    command = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null", "--toggle-collect=c_step", *program]
    said = subprocess.run(command, capture_output=True, text=True, check=False).stderr
    found = re.search(r"Collected : (\d+)", said)
    assert found is not None, said
    return int(found[1])


def _limited(problem: fp.Problem, states: Limited) -> fp.Problem:
    return replace(problem, limits=replace(problem.limits, states=states)) if states else problem


def _called(problem: str, title: str, states: Limited) -> str:
    return ", ".join([problem, title, *(f"{name} limited" for name in states)])


def unit_row(problem: str, title: str, target: str) -> list[str]:
    """One line of the table of units: what FMPy finds, and how far commands are from those of the run.

    The plant of two_mass, which is measured as it is, runs beside the unit; of other problems the samples of the run are given.
    """
    from fmi_master import apart_from_a_run, with_samples_of_a_run
    from fmpy.validation import validate_fmu

    task = fp.load_problem(problem)
    device = device_of(task.problem, task.controllers[title], title, name="c", cycles=1)
    with tempfile.TemporaryDirectory() as name:
        write(device, target_called(target), Path(name))
        path = Path(name) / "c.fmu"
        found, size = len(validate_fmu(str(path))), path.stat().st_size
        sizes = (Path(name) / "sizes.txt").read_text()
        told = [
            int(one)
            for one in re.findall(r"(?:x86_64-linux|linux64)/c.so: (\d+)|instance: (\d+)", sizes)
            for one in one
            if one
        ]
        stack = _frames(path, Path(name) / "in")
        run = fp.simulate(device.problem, device.controller, seed=0)
        columns = [name for name in device.inputs.names if name != "time"]
        apart, commands, took = with_samples_of_a_run(run, columns, path, CYCLES)
        ways = [f"{apart:.1g}", ""]
        if problem == "two_mass":
            through, late = (
                apart_from_a_run(device.problem, device.controller, path, CYCLES, late=late)[1]
                for late in (False, True)
            )
            ways = [f"{through:.1g}", f"{late:.3g}"]
    return [f"{problem}, {title}", target, f"{size / 1000:.0f}", *(f"{one / 1000:.1f}" for one in (*told, stack)),
            f"{1e6 * took:.0f}", f"{found}", *ways, _hash(commands)]  # fmt: skip


def _frames(unit: Path, folder: Path) -> int:
    """Bytes of stack of a unit: its sources with the optimisation of its libraries."""
    with zipfile.ZipFile(unit) as archive:
        archive.extractall(folder)
    for source in sorted((folder / "sources").glob("*.c")):
        flags = ["-std=c99", "-O2", "-ffp-contract=off", "-fstack-usage"]
        subprocess.run([str(find_compiler()), *flags, "-c", source.name], cwd=folder / "sources", check=True)
    return deepest([one for one in said_by_gcc(folder / "sources") if not re.match(r"fmi\d(?!DoStep)", one[0])], "c")


def _hash(commands: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(commands).tobytes()).hexdigest()[:12]


def web_row(problem: str, title: str) -> list[str]:
    """One line of the table of WebAssembly: its size, and the hash of the commands there and in C here."""
    task, compiler = fp.load_problem(problem), str(find_compiler())
    device = device_of(task.problem, task.controllers[title], title, name="c", cycles=CYCLES, libm="own")
    with tempfile.TemporaryDirectory() as name:
        web, here = Path(name) / "web", Path(name) / "c"
        write(device, target_called("wasm"), web)
        write(device, target_called("c"), here)
        module = (web / "c.wasm").read_bytes()
        sources, program = [str(path) for path in sorted(here.glob("*.c"))], here / "replay"
        subprocess.run(
            [compiler, "-std=c99", "-O2", "-ffp-contract=off", *sources, "-o", str(program), "-lm"], check=True
        )
        texts = (_said("node", str(web / "replay.mjs")), _said(str(program), str(here / "samples.bin")))
        memory, stack, counts = _in_wasmtime(web)
    hashes = [text.split("answers ")[1][:12] for text in texts]
    apart = re.search(r"off by at most (\S+) of", texts[0])
    assert apart is not None
    sizes = (len(module), len(gzip.compress(module)))
    return [f"{problem}, {title}", *(f"{size / 1000:.0f}" for size in sizes), f"{memory / 1000:.1f}", f"{stack / 1000:.1f}",
            f"{np.mean(counts):.0f}", f"{max(counts)}", f"{float(apart[1]):.1g}", *hashes]  # fmt: skip


def _in_wasmtime(folder: Path) -> tuple[int, int, list[int]]:
    """Bytes of memory, of stack that is reached, and the instructions of each recorded cycle.

    wasmtime takes one unit of fuel for an instruction of WebAssembly.
    """
    import wasmtime  # type: ignore[import-not-found]

    settings = wasmtime.Config()
    settings.consume_fuel = True
    store = wasmtime.Store(wasmtime.Engine(settings))
    store.set_fuel(10**15)
    e = wasmtime.Instance(store, wasmtime.Module.from_file(store.engine, str(folder / "c.wasm")), []).exports(store)
    if "_initialize" in e:
        e["_initialize"](store)
    e["init"](store)
    data, given, counts = (folder / "samples.bin").read_bytes(), e["inputs"](store), []
    _, inputs, commands, _ = struct.unpack_from("<4i", data)
    rows = np.frombuffer(data, offset=16).reshape(CYCLES, inputs + 1 + commands + 2)
    for row in rows:
        e["memory"].write(store, row[:inputs].tobytes(), given)
        before = store.get_fuel()
        e["step"](store)
        counts.append(before - store.get_fuel())
    stack = bytes(e["memory"].read(store, 0, WEB_STACK)).lstrip(b"\0")  # it comes first, and grows down
    return e["memory"].data_len(store), len(stack), counts


def cortex_rows(problem: str, title: str, states: Limited, most: int = 0) -> list[list[str]]:
    """Lines of the table of Cortex-M, M7 and M4F: sizes, instructions, and the commands of a run with it and with C here.

    `most`: iterations of a call with limits of states; 0: those of the problem file.
    """
    task = fp.load_problem(problem)
    controller = task.controllers[title]
    if most:
        controller = replace(controller, optimiser=replace(controller.optimiser, most_iterations=most))
    duration = min(500 * task.problem.period, task.problem.duration)
    shorter = replace(_limited(task.problem, states), duration=duration, measure_from=0.0)
    device = device_of(shorter, controller, title, name="c", cycles=1, libm="own")
    called = _called(problem, title, states) + (f", most_iterations={most}" if most else "")
    with tempfile.TemporaryDirectory() as name:
        board, here = Path(name) / "board", Path(name) / "c"
        write(device, target_called("cortex-m"), board)
        write(device, target_called("c"), here)
        program = processor_of(target_called("c"))(here, "c")
        run = fp.simulate(shorter, device.controller, seed=0)
        other = fp.simulate(shorter, fp.Processor(program), seed=0)
        rows = []
        for place, machine in (("m7", "mps2-an500"), ("m4f", "mps2-an386"))[: 1 if most else 2]:
            image = board / f"c_{place}.elf"
            looped = fp.simulate(shorter, fp.Processor([*QEMU, str(image), "-M", machine]), seed=0)
            text = _lines(looped, device.inputs.names)
            emulated, said = _emulated(image, text)
            if place == "m7":
                there = subprocess.run(program, input=text, capture_output=True, check=True).stdout
                assert there == said, "the answers of the emulated processor differ"
            of, tried = ("M7", run) if place == "m7" else ("M4F, float", None)  # the plans of a float are its own
            rows.append(
                [called, of, *_numbers_of(emulated, Image(image), run, looped, tried), _hash(looped["command"])]
            )
        rows[0].append(_hash(other["command"]))
        rows[1:] = [[*one, ""] for one in rows[1:]]
    return rows


def _lines(run: fp.Run, names: tuple[str, ...]) -> bytes:
    """The samples of a run as lines for a processor."""
    given = np.hstack([run[n].reshape(len(run.time), -1) if n != "time" else run.time[:, None] for n in names])
    rows = (b" ".join(b"%016x" % word for word in row.view(np.uint64).tolist()) for row in given)
    return b"r\n" + b"".join(b"s " + row + b"\n" for row in rows)


def _emulated(image: Path, text: bytes) -> tuple[Board, bytes]:
    """A processor after it has answered lines, and the answers."""
    answers = io.BytesIO()
    board = Board(Image(image), io.BytesIO(text), answers, "c_step")
    board.run()
    return board, answers.getvalue()


def _numbers_of(board: Board, image: Image, run: fp.Run, looped: fp.Run, solved: fp.Run | None) -> list[str]:
    """Columns of the table of Cortex-M: sizes, instructions, and how far the commands of the loop are from those of the run."""
    counts = board.counts
    longest = int(np.argmax(counts))
    tried = int(solved["solve"][longest][3]) if solved is not None and "solve" in solved.layout else 0
    each = [f"{tried}", f"{counts[longest] / tried:.0f}"] if tried > 0 else ["", ""]
    sizes = (f"{image.size(0) / 1000:.0f}", f"{image.size(0x20000000) / 1000:.0f}", f"{board.stack() / 1000:.1f}")
    apart = np.abs(looped["command"] - run["command"]).max()
    return [*sizes, f"{np.mean(counts):.0f}", f"{max(counts)}", *each, f"{apart:.1g}"]


def misra_rows() -> list[list[str]]:
    """Lines of the table of deviations: the rule, how often each controller deviates, and why."""
    devices = (
        device_of(task.problem, task.controllers[title], title, name="c", cycles=1)
        for task, title in ((fp.load_problem(problem), title) for problem, title in PLAIN)
    )
    counts = [deviations(sources(device)) for device in devices]
    return [[rule, *(str(count[rule]) for count in counts), why] for rule, why in reasons(set().union(*counts))]


def board_row(problem: str, title: str, bare: bool) -> list[str]:
    """One line of the table of small boards: what a controller takes of them, its longest step and its commands there."""
    task = fp.load_problem(problem)
    device = device_of(task.problem, task.controllers[title], title, name="c", cycles=1, bare=bare)
    called, took, apart, digest = f"{problem}, {title}{', bare' if bare else ''}", "", "", ""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "uno"
        try:
            write(device, target_called("arduino"), folder)
        except NotSupported as error:
            lacks = [re.search(rf"{board} (lacks [^;.]*)", str(error)) for board in ("Uno", "Mega 2560")]
            return [called, "", "", *(found[1] if found else "" for found in lacks), "", "", ""]
        said = (folder / "sizes.txt").read_text()
        fitting = [line.partition(":")[0] for line in said.splitlines() if line.endswith(": fits")]
        if fitting:
            run = fp.simulate(task.problem, device.controller, seed=0)
            columns = (np.reshape(run[n], (len(run.time), -1)) for n in device.inputs.names)
            commands, longest = answered(folder, "c", np.hstack(list(columns))[:60], PROCESSORS[fitting[0]])
            wanted = run["command"][:60]
            took, apart = f"{1e3 * longest:.2f}", f"{np.abs(commands - wanted).max() / np.abs(wanted).max():.1g}"
            digest = _hash(commands)
    sizes = re.search(r"Uno: (\d+) of .*?, (\d+ \+ \d+) of stack", said)
    assert sizes is not None
    words = [re.search(rf"{board}: .*: (?:does not fit: )?(fits|lacks .*)", said) for board in ("Uno", "Mega 2560")]
    fits = [found[1] if found else "" for found in words]
    return [called, f"{int(sizes[1]) / 1000:.1f}", sizes[2], *fits, took, apart, digest]


def _said(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


TABLES: dict[str, tuple[list[str], Callable[[], list[list[str]]]]] = {
    "table": (
        [
            "controller",
            "code, kB",
            "struct, kB",
            "stack, kB",
            "memory",
            "work",
            "instructions",
            "cycles that differ",
            "answers",
        ],
        lambda: [row(*case) for case in CASES],
    ),
    "units": (
        [
            "controller",
            "target",
            "archive, kB",
            "library, kB",
            "instance, kB",
            "stack, kB",
            "step, us",
            "problems by FMPy",
            "command, inputs pass through",
            "one period late",
            "commands",
        ],
        lambda: [unit_row(*case, target) for case in PLAIN for target in ("fmu", "fmu2")],
    ),
    "cortex": (
        [
            "controller",
            "processor",
            "code, kB",
            "data, kB",
            "stack, kB",
            "instructions, mean",
            "most",
            "iterations then",
            "for each",
            "command",
            "commands in QEMU",
            "commands here",
        ],
        lambda: [
            one
            for case in (*((*case, 0) for case in CASES), *((*CASES[2], most) for most in (2, 1)))
            for one in cortex_rows(*case)
        ],
    ),
    "misra": (["rule", *map(", ".join, PLAIN), "why it stays"], misra_rows),
    "boards": (
        [
            "controller",
            "flash, kB",
            "RAM, stack, bytes",
            "Uno",
            "Mega 2560",
            "longest step, ms",
            "command, relative",
            "commands",
        ],
        lambda: [board_row(*case, bare) for case in SMALL for bare in (True, False)],
    ),
    "web": (
        [
            "controller",
            "module, kB",
            "compressed, kB",
            "memory, kB",
            "stack, kB",
            "instructions, mean",
            "most",
            "command",
            "commands in Node",
            "commands in C here",
        ],
        lambda: [web_row(*case) for case in PLAIN],
    ),
}


def main() -> None:
    """Measure and write: every table of the page, or those that are named."""
    warnings.simplefilter("ignore", fp.HarmfulAdaptation)
    reader = argparse.ArgumentParser(description=main.__doc__)
    reader.add_argument("tables", nargs="*", metavar="TABLE", help=f"of {', '.join(TABLES)}; all by default")
    names = reader.parse_args().tables
    if unknown := [name for name in names if name not in TABLES]:
        reader.error(f"unknown tables {', '.join(unknown)}; expected some of {', '.join(TABLES)}")
    for name in names or TABLES:
        head, measured = TABLES[name]
        rows = measured()
        PAGE.write_text(_filled(PAGE.read_text(encoding="utf-8"), name, head, rows), encoding="utf-8")


def _filled(text: str, place: str, head: list[str], rows: list[list[str]]) -> str:
    table = "\n".join("| " + " | ".join(one) + " |" for one in [head, ["---"] * len(head), *rows])
    return re.sub(rf"(<!-- {place} -->\n).*?(<!-- end -->)", rf"\1{table}\n\2", text, flags=re.DOTALL)


if __name__ == "__main__":
    main()
