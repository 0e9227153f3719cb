"""`fpirhc lab PROBLEM --out FILE.html`: a page in which the problem's loops run while sliders move."""

from __future__ import annotations

import argparse
from pathlib import Path

from fpirhc.cli.options import add_problem
from fpirhc.cli.output import output_folder
from fpirhc.cli.verb import ExitCode, Verb


def _add(parser: argparse.ArgumentParser) -> None:
    add_problem(parser)
    text = "names of controllers (default: the pair of the headline)"
    parser.add_argument("--controllers", nargs="+", metavar="NAME", help=text)
    text = "settings with a slider (default: gains, rates, limits of inputs, dead times, the reference); parameters always have one"
    parser.add_argument("--live", nargs="+", default=[], metavar="PATH", help=text)
    parser.add_argument(
        "--out", metavar="FILE", help="the page, such as page.html, or a folder for it (default: results)"
    )


def _run(options: argparse.Namespace) -> ExitCode:
    from fpirhc.export.lab.lab import lab_of, write_lab
    from fpirhc.problem_files.problem_file import load_problem

    task = load_problem(options.problem)
    path = page_in(Path(options.out or "results"), task.name)
    output_folder(path.parent)
    lab = lab_of(task, options.problem, options.controllers or (), options.live)
    write_lab(lab, path)
    print(f"{len(lab.sliders)} sliders for {', '.join(loop.name for loop in lab.loops)}")
    for number, why in lab.without.items():
        print(f"no slider for {number}: {why}")
    print(f"wrote {path}")
    return ExitCode.FINISHED


def page_in(place: Path, name: str) -> Path:
    """Return the path of a problem's page: the place where it is a file, which has an ending, else a file in this folder."""
    return place if place.suffix and not place.is_dir() else place / f"{name}-lab.html"


VERB = Verb(
    name="lab",
    summary="write a page in which the loops run while sliders move",
    add=_add,
    run=_run,
    codes={ExitCode.NOT_WRITABLE: "the page cannot be written"},
    examples=(
        ("fpirhc lab two_mass", "RHC and RHC+FPI, with sliders for parameters, gain and limits"),
        ('fpirhc lab two_mass --controllers "CTC" "CTC+FPI (eq 6)" --live deformation.gain tracking.rate', "others"),
    ),
    notes="""
The page is one file, opens offline, and loads nothing: the loops are in it as WebAssembly (zig compiles them: pip install
'fpirhc[compiler]'). A slider is left out where Python would have to compute something that follows from its number.
""",
)
