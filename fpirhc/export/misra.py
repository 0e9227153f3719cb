"""Where the C of an exported controller deviates from the rules of MISRA C:2012, by cppcheck, and why that stays."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

from fpirhc.errors import CompileError, NotInstalled
from fpirhc.export.device import Device
from fpirhc.export.targets.c import sources

_REASONS = {
    "2.2": "a value that a later line overwrites, in generated code",
    "2.3": "a type of the settings that the optimiser can do without",
    "2.4": "a tag of a type that is used by its name",
    "2.5": "macros of sizes for the caller",
    "5.5": "a macro has the name of the symbol that it stands for",
    "5.6": "the same type is named in several files",
    "5.7": "the same struct is declared in several files",
    "5.9": "names of functions that are static in several files",
    "8.4": "the function of another file is declared where it is called",
    "8.7": "the same function has external linkage in files of its own",
    "8.9": "tables of start values stand at file scope, next to each other",
    "8.14": "restrict: the optimiser's numbers are nobody else's",
    "9.3": "a table of zeros has one initialiser",
    "10.3": "comparisons are numbers in generated code",
    "10.4": "whole numbers and flags in one expression",
    "10.6": "a product of whole numbers goes into a wider one",
    "10.8": "a whole number becomes a real one after its sum",
    "11.3": "a struct of numbers alone is read as their array, without gaps",
    "11.9": "0 for a pointer, in generated code",
    "12.1": "precedence of conditional expressions",
    "12.3": "declarations and assignments joined by commas",
    "13.3": "copies of generated code advance two pointers in one line",
    "13.4": "a number is assigned to several places",
    "14.2": "the loops of the optimiser, and over missed cycles, end within",
    "14.4": "a pointer that may be null, or a comparison that is a number, is a condition",
    "15.5": "a function returns where it is done",
    "15.6": "a body of one line without braces",
    "15.7": "the last way of several does nothing",
    "17.7": "memcpy and memset return what nobody needs",
    "17.8": "an argument is advanced where it stands",
    "18.4": "places in the array of numbers are reached by addition",
    "19.2": "the first byte of a number is read on an AVR",
    "20.1": "what the search includes stands before it, behind generated code",
    "20.5": "own functions compute in double, whatever the type of the controller",
    "20.7": "a macro of a type",
    "20.9": "the type of the controller is asked by its name",
    "20.10": "names are joined to ask for the type of the controller",
    "21.1": "own functions take the place of exp, sin and the like",
}


def checker() -> str:
    """Return the program that checks.

    Raises:
        NotInstalled: there is none.
    """
    command = shutil.which("cppcheck")
    if command is None:
        raise NotInstalled("--misra needs cppcheck, which is not installed: package cppcheck")
    return command


def deviations(files: Mapping[str, str]) -> Counter[str]:
    """Return how often C files deviate from each rule, by its number."""
    with tempfile.TemporaryDirectory() as name:
        for file, text in files.items():
            (Path(name) / file).write_text(text, encoding="utf-8")
        texts = [file for file in files if file.endswith(".c")]
        command = [checker(), "--addon=misra", "--std=c99", "-q", "--template={id}", *texts]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=name)
    if done.returncode:
        raise CompileError(f"cppcheck ended with {done.returncode}: {(done.stderr or done.stdout).strip()[-500:]}")
    return Counter(re.findall(r"misra-c2012-([\d.]+)", done.stderr))


def reasons(rules: Iterable[str]) -> list[tuple[str, str]]:
    """Return rules in their order, each with the reason why deviations from it stay."""
    ordered = sorted(rules, key=lambda rule: [int(part) for part in rule.split(".")])
    return [(rule, _REASONS.get(rule, "of this controller alone: to be looked at")) for rule in ordered]


def report(device: Device) -> str:
    """Return a page with the deviations of a controller."""
    counts = deviations(sources(device))
    rows = [f"| {rule} | {counts[rule]} | {why} |" for rule, why in reasons(counts)]
    return "\n".join([
        f"# {device.title}: deviations from MISRA C:2012", "",
        f"By cppcheck, on the files of `{device.name}`; {counts.total()} deviations from {len(counts)} rules.", "",
        "| rule | deviations | why they stay |", "| --- | --- | --- |", *rows, "",
    ])  # fmt: skip
