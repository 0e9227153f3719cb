"""The lines of code of a file, as the house counts them."""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterable

SILENT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING}


def code_lines(text: str) -> list[str]:
    """Lines that hold a token of code: no comments, no blank lines, no docstrings."""
    documented = {at for node in ast.walk(ast.parse(text)) for at in _docstring(node)}
    kept: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in SILENT:
            kept.update(range(token.start[0], token.end[0] + 1))
    every = ["", *text.splitlines(), ""]
    return [every[k] for k in sorted(kept - documented) if k < len(every)]


def _docstring(node: ast.AST) -> Iterable[int]:
    holds = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
    if not holds or ast.get_docstring(node, clean=False) is None:
        return ()
    first = node.body[0]
    return range(first.lineno, (first.end_lineno or first.lineno) + 1)
