"""`fpirhc` and `python -m fpirhc`: runs a command, and says in one line what ended it."""

from __future__ import annotations

import errno
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Sequence
from typing import Any

from typer import Abort, Exit
from typer.main import get_command

from fpirhc.cli import list_
from fpirhc.options import MADE, app

_KEEP = "study", "tune"  # commands that keep what is finished
_INTERRUPTED = "interrupted"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    for one in (getattr(signal, name, None) for name in ("SIGTERM", "SIGHUP")):
        # A service that is stopped and a terminal that is closed end a run as Ctrl-C does: a real plant is left at rest.
        if one and signal.getsignal(one) == signal.SIG_DFL and threading.current_thread() is threading.main_thread():
            signal.signal(one, signal.default_int_handler)
    # Matrices of loops are small: threads of the linear algebra wait for one another. NumPy reads this when it is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for stream in (sys.stdout, sys.stderr):  # names of a user that the encoding of an output does not have are escaped
        getattr(stream, "reconfigure", lambda **_: None)(errors="backslashreplace")
    try:
        code = int(_run([word for word in words if word != "--debug"]) or 0)
        text = _INTERRUPTED if code == 130 else ""  # typer turns an interruption into a code
        sys.stdout.flush()  # a reader that has gone shows here, and not at the end of the program
    except BaseException as error:  # noqa: BLE001 -- the last resort of a program
        if "--debug" in words and not isinstance(error, KeyboardInterrupt):
            traceback.print_exc()
        text, code = _ended_by(error)
    finally:
        from fpirhc.whole_file import remove_empty

        remove_empty(MADE)
        MADE.clear()
    if text:
        text += "; what is finished is kept, and the same command goes on" * (code == 130 and words[0] in _KEEP)
        from fpirhc.summary import printable

        print(f"fpirhc: {printable(text)}", file=sys.stderr)
    return code


def _run(words: list[str]) -> Any:
    if words == ["list"]:  # is quick: typer reads even no options with pydantic, longer to import than casadi
        return list_()
    command: Any = get_command(app)
    if not words or words[0] == "help":  # as git, pip and cargo have it
        words = [*words[1:2], "--help"]
    if words[0] not in command.commands and not words[0].startswith("-"):
        from fpirhc.errors import InvalidName, nearest

        mend = f" Write fpirhc compare {words[0]}." if words[0].endswith(".py") else ""
        raise InvalidName(f"the command '{words[0]}' is unknown.{mend}{nearest(words[0], command.commands)}")
    return command.main(words, prog_name="fpirhc", standalone_mode=False)


def _ended_by(error: BaseException) -> tuple[str, int]:
    """One line about what ended the command, and its exit code."""
    from fpirhc.errors import FpirhcError, OutputError

    causes = [error]  # a solver that is interrupted passes it on inside another error
    while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None and cause not in causes:
        causes.append(cause)
    text, code = str(error), 2
    if any(isinstance(one, BrokenPipeError) for one in causes[:2]):
        # Writing what is still in the buffer at the end of the program would fail once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        text, code = "", 141
    elif any(isinstance(one, KeyboardInterrupt | Abort) or "KeyboardInterrupt" in str(one) for one in causes):
        text, code = _INTERRUPTED, 130
    elif isinstance(error, Exit | SystemExit):
        text, code = "", int(getattr(error, "exit_code", getattr(error, "code", 0)) or 0)
    elif isinstance(error, FpirhcError):
        code = 3 if isinstance(error, OutputError) else 2
    elif hasattr(error, "format_message"):
        text = _of_typer(error)
    elif isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        text, code = f"the disk is full ({error.filename or 'output'})", 3
    else:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        name = f"{type(error).__name__} in {os.path.basename(frame.filename)}, line {frame.lineno}"
        said = " ".join(text.split())[:300]
        text, code = f"an error inside fpirhc: {name}: {said}; please report it with what --debug prints", 70
    return text, code


def _of_typer(error: Any) -> str:
    """What typer says of wrong words, with the nearest option."""
    from fpirhc.errors import nearest

    context, text = getattr(error, "ctx", None), error.format_message().rstrip(".").removeprefix("Invalid value: ")
    text = re.sub("Input should be (?:a valid )?([^,]*)(?:, unable.*)?", r"expected \1", text)
    if context is None:
        return str(text)
    if type(error).__name__ == "NoSuchOption":
        valid = [name for one in context.command.get_params(context) for name in one.opts if name.startswith("--")]
        text = f"the option '{error.option_name}' is unknown.{nearest(error.option_name, valid)}".rstrip(".")
    if getattr(getattr(error, "param", None), "name", "") == "controller" and context.params.get("problem"):
        from fpirhc.errors import FpirhcError, listed
        from fpirhc.problem_files.problem_file import load_problem

        try:
            text = f"{text}: one of {listed([*load_problem(context.params['problem']).controllers])}"
        except FpirhcError as wrong:  # in the file
            return str(wrong)
    return f"{text}. See {context.command_path} --help"


if __name__ == "__main__":
    sys.exit(main())
