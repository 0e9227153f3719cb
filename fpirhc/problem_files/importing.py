"""Imports a problem file; an error of the file names its line, its cause, and what to write instead.

Python shows the first mistake of a file. To find all, its statements run once more, one by one. Of a statement that fails or needs
what is missing, those calls of fpirhc still run that need nothing missing; of the others, the arguments that are there are checked.
"""

from __future__ import annotations

import ast
import contextlib
import importlib.util
import io
import linecache
import sys
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from fpirhc.errors import FpirhcError, InvalidField, ProblemFileError
from fpirhc.fields.checked import Checked, mistakes_of
from fpirhc.fields.user_code import explained


def imported(path: Path) -> ModuleType:
    """Return the module of a problem file.

    Raises:
        ProblemFileError: the file raises an error, or is not Python; every mistake has its line.
    """
    module = _empty(path)
    try:
        with _neighbours(path):
            # Bytecode would be that of the last second: it is told apart by the file's size and whole seconds.
            exec(compile(path.read_bytes(), str(path), "exec", dont_inherit=True), vars(module))
    except SyntaxError as error:
        source, name = (error.text or "").strip(), Path(error.filename or path).name
        raise ProblemFileError(f"{name}, line {error.lineno}: {error.msg}\n    {source}") from None
    except SystemExit as error:
        raise ProblemFileError(_message(path, error, "the file ends the program; leave the exit out")) from None
    except Exception as error:  # noqa: BLE001 -- every error of a user's file is shown with its line
        with _neighbours(path):
            every = _MistakesOfFile(path, _empty(path)).text()
        raise ProblemFileError(every or _message(path, error, _cause_of(error))) from None
    return module


def line_of(module: ModuleType, name: str) -> str:
    """Return "line 12: " of the last assignment of a name in a module's file; empty where there is none."""
    try:
        tree = ast.parse(Path(module.__file__ or "").read_text(encoding="utf-8"))
    except (OSError, SyntaxError, ValueError):
        return ""
    lines = [
        target.lineno
        for node in tree.body
        for target in (node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)])
        if isinstance(target, ast.Name) and target.id == name
    ]
    return f"line {lines[-1]}: " if lines else ""


def _empty(path: Path) -> ModuleType:
    """The module of a file before its first line."""
    spec = importlib.util.spec_from_file_location(f"fpirhc_problem_{path.stem}", path)
    if spec is None:
        raise ProblemFileError(f"'{path}' is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    return module


@contextlib.contextmanager
def _neighbours(path: Path) -> Iterator[None]:
    """Let a file import the modules beside it, as a program can; libraries come first.

    The modules are forgotten afterwards: another folder may have others of the same name.
    """
    folder, before = str(path.resolve().parent), set(sys.modules)
    sys.path.append(folder)
    try:
        yield
    finally:
        sys.path.remove(folder)
        for name in set(sys.modules) - before:
            file = getattr(sys.modules[name], "__file__", None)
            if file and Path(file).parent == Path(folder) and not name.startswith("fpirhc_problem_"):
                del sys.modules[name]


@dataclass
class _MistakesOfFile:
    """The mistakes of a file that has raised an error.

    Args:
        path: of the file.
        module: its module, without names of the file's own.
        missing: names that are not defined, because what should define them failed.
        said: line -> messages.
    """

    path: Path
    module: ModuleType
    missing: set[str] = field(default_factory=set)
    said: dict[int, list[str]] = field(default_factory=dict)

    def text(self) -> str:
        """Return every mistake once, by line: "file.py, line 12: source", and the cause below it."""
        with contextlib.redirect_stdout(io.StringIO()):  # what the file prints is on the screen already
            for statement in ast.parse(self.path.read_bytes()).body:
                if self._lacks(statement) or not self._runs(statement):
                    self.missing |= set(_defined(statement))
                    for call in _calls(statement):
                        self._check(call)
        return "\n".join(
            f"{_place(self.path, line)}\n    {one}" for line in sorted(self.said) for one in self.said[line]
        )

    def _lacks(self, source: ast.AST) -> bool:
        """Whether a piece of source needs a name that is missing."""
        return any(isinstance(n, ast.Name) and n.id in self.missing for n in ast.walk(source))

    def _runs(self, statement: ast.stmt) -> bool:
        """Run a statement; its error is kept."""
        try:
            exec(compile(ast.Module([statement], []), self.path, "exec"), vars(self.module))
        except Exception as error:  # noqa: BLE001 -- every error of a user's file is shown
            self._keep(statement, error)
            return False
        return True

    def _check(self, call: ast.Call) -> None:
        """Run a call of fpirhc that needs nothing missing; of another one, check the named arguments that do not."""
        try:
            one = None if self._lacks(call.func) else self._value(call.func)
            if not getattr(one, "__module__", "").startswith("fpirhc"):
                return
            if not self._lacks(call):
                self._value(call)
            elif isinstance(one, type) and issubclass(one, Checked):
                wrong = tuple(mistakes_of(one, dict(self._named(call))))
                if wrong:
                    self._keep(call, InvalidField(wrong))
        except FpirhcError as error:
            self._keep(call, error)
        except Exception:  # noqa: BLE001 -- the statement around it has told it
            return

    def _named(self, call: ast.Call) -> Iterator[tuple[str, object]]:
        """Name and value of the named arguments that have one."""
        for one in call.keywords:
            if one.arg and not self._lacks(one.value):
                with contextlib.suppress(Exception):  # an argument that fails is told where it stands
                    yield one.arg, self._value(one.value)

    def _value(self, source: ast.expr) -> Any:
        return eval(compile(ast.Expression(source), self.path, "eval"), vars(self.module))

    def _keep(self, source: ast.stmt | ast.expr, error: Exception) -> None:
        messages = self.said.setdefault(_line(self.path, error) or source.lineno, [])
        if _cause_of(error) not in messages:
            messages.append(_cause_of(error))


def _message(path: Path, error: BaseException, cause: str) -> str:
    """Return "file.py, line 12: source" of the innermost line of the file in the traceback, and the cause below it."""
    line = _line(path, error)
    return f"{_place(path, line) if line else path.name}\n    {cause}"


def _cause_of(error: Exception) -> str:
    """What an error says, without the place, and with what to write instead."""
    if isinstance(error, InvalidField):
        return error.text.lstrip()
    if isinstance(error, FpirhcError):
        return str(error)
    cause = explained(error)
    if not cause.startswith(type(error).__name__):
        return cause
    # Python's own last line also has the nearest name that it knows.
    return "".join(traceback.TracebackException.from_exception(error).format_exception_only()).strip()


def _line(path: Path, error: BaseException) -> int | None:
    """The innermost line of the file in the traceback."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).resolve() == path.resolve()]
    return frames[-1].lineno if frames else None


def _place(path: Path, line: int) -> str:
    return f"{path.name}, line {line}: {linecache.getline(str(path), line).strip()}"


def _calls(source: ast.AST) -> Iterator[ast.Call]:
    """Calls that happen where the source stands, the inner ones first; not those of functions and loops in it."""
    if isinstance(source, _LATER):
        return
    for child in ast.iter_child_nodes(source):
        yield from _calls(child)
    if isinstance(source, ast.Call):
        yield source


def _defined(statement: ast.stmt) -> Iterator[str]:
    """Names that a statement defines."""
    for node in ast.walk(statement):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.alias):
            yield node.asname or node.name.partition(".")[0]


_LATER = (ast.Lambda, ast.FunctionDef, ast.ClassDef, ast.ListComp, ast.DictComp, ast.SetComp, ast.GeneratorExp)
