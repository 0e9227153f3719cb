"""`fpirhc completion SHELL`: a script with which a shell completes commands, options, problems and files.

It is made by shtab from the parsers of the commands. The shell needs neither Python nor this package while it completes.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from fpirhc.cli.verb import ExitCode, Verb, known

SHELLS = ("bash", "zsh", "fish", "tcsh")
FOLDERS, FILES = ("out", "baselines"), ("tuned", "markdown")  # destinations of options
PROBLEMS = ("problem", "problems")


def script(shell: str) -> str:
    """Return the completion script of a shell."""
    from fpirhc.errors import NotInstalled, package

    shtab = package("shtab", "completion", "completion")
    if shell not in shtab.SUPPORTED_SHELLS:
        raise NotInstalled(f"this version of shtab has no completion for {shell}; install a newer one")
    return str(shtab.complete(whole_parser(), shell))


def whole_parser() -> argparse.ArgumentParser:
    """Return one parser of all commands, with what each argument is completed by in its attribute `complete`."""
    parser = argparse.ArgumentParser(prog="fpirhc", description="Adaptive receding-horizon control.")
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    commands = parser.add_subparsers()
    for one in known().values():
        command = commands.add_parser(one.name, help=_plain(one.summary), description=_plain(one.summary))
        one.load().add(command)
        for action in command._actions:
            _set_completion(action)
    return parser


def _set_completion(action: argparse.Action) -> None:
    """Say by what an argument is completed; choices and names of options need no more."""
    if action.dest in PROBLEMS:
        vars(action)["complete"] = _problems()
    elif action.dest in FOLDERS:
        vars(action)["complete"] = {"bash": "_shtab_compgen_dirs", "zsh": "_files -/", "tcsh": "d"}
    elif action.dest in FILES:
        vars(action)["complete"] = {"bash": "_shtab_compgen_files", "zsh": "_files", "tcsh": "f"}


def _problems() -> dict[str, object]:
    """Names of shipped problems, and problem files."""
    from fpirhc.problem_files.shipped import shipped_problems

    names = " ".join(shipped_problems())
    bash = f'_fpirhc_problems() {{\n  compgen -W "{names}" -- "$1"\n  compgen -f -X "!*.py" -- "$1"\n  compgen -d -- "$1"\n}}'
    zsh = f"_fpirhc_problems() {{\n  compadd -- {names}\n  _files -g '*.py'\n}}"
    return {
        "bash": "_fpirhc_problems",
        "zsh": "_fpirhc_problems",
        "tcsh": "f:*.py",
        "preamble": {"bash": bash, "zsh": zsh},
    }


def _plain(text: str) -> str:
    """A summary without characters that a shell reads inside a script."""
    return "".join(c for c in text if c.isalnum() or c in " ,.-()/")


def instructions() -> Sequence[tuple[str, str]]:
    """Return for each shell how its script is put in place."""
    return (
        ("bash", "fpirhc completion bash > ~/.local/share/bash-completion/completions/fpirhc"),
        ("zsh", "fpirhc completion zsh > ~/.zfunc/_fpirhc    (with ~/.zfunc in fpath before compinit)"),
        ("fish", "fpirhc completion fish > ~/.config/fish/completions/fpirhc.fish"),
        ("tcsh", "fpirhc completion tcsh > ~/.fpirhc.tcsh    (and source it in ~/.tcshrc)"),
    )


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", metavar="SHELL", choices=SHELLS, help=", ".join(SHELLS))


def _run(options: argparse.Namespace) -> ExitCode:
    print(script(options.shell))
    return ExitCode.FINISHED


VERB = Verb(
    name="completion",
    summary="print a script with which a shell completes this command line",
    add=_add,
    run=_run,
    codes={ExitCode.BAD_INPUT: f"{ExitCode.BAD_INPUT.meaning}; or shtab is missing"},
    examples=(("fpirhc completion bash", "for bash; also zsh, fish and tcsh"),),
    notes="Put the script where the shell looks for it:\n" + "\n".join(f"  {line}" for _, line in instructions()),
)
