"""Runs the Python of the pages."""

from __future__ import annotations

import ast
import asyncio
import inspect
import io
import re
import tokenize
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from support.pages.blocks import Block
    from support.pages.stage import Stage


class Ended(Exception):
    """An example that goes on without end has shown enough."""


def python(block: Block, stage: Stage) -> None:
    """Runs Python, with the names of the blocks before, and compares what comments say.

    A server on a fixed port gets one that the system picks. `input` returns at once. An endless
    example ends after ten lines.
    """
    text = re.sub(r'(bind="(?:[a-z+]+://)?127\.0\.0\.1):\d+"', r'\1:0"', block.text)
    text = stage.here(text)
    tree = _Told(_comments(text)).visit(ast.parse(text))
    ast.fix_missing_locations(tree)
    code = compile(tree, block.place, "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
    printed: list[str] = []

    def print_(*values: object) -> None:
        printed.append(" ".join(map(str, values)))
        if len(printed) == 10:
            raise Ended

    stage.names |= {"_told": _told, "print": print_, "input": print_, "__name__": "example"}
    try:
        running = eval(code, stage.names)  # Returns a coroutine if it awaits.
        if inspect.iscoroutine(running):
            asyncio.run(running)
    except Ended:
        pass
    stage.output = "\n".join(printed)


def _comments(text: str) -> dict[int, str]:
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return {
        each.start[0]: each.string.lstrip("# ") for each in tokens if each.type == tokenize.COMMENT
    }


class _Told(ast.NodeTransformer):
    """Compares each expression, or what is printed, with the comment in its line."""

    def __init__(self, comments: dict[int, str]) -> None:
        self._comments = comments

    def visit_Expr(self, node: ast.Expr) -> ast.Expr:
        comment = self._comments.get(node.end_lineno or 0)
        if comment is None or isinstance(node.value, ast.Await):
            return node
        value = node.value
        printed = isinstance(value, ast.Call) and ast.unparse(value.func) == "print"
        if printed:
            assert isinstance(value, ast.Call)
            [value] = value.args
        given = [value, ast.Constant(comment), ast.Constant(printed)]
        return ast.Expr(ast.Call(ast.Name("_told", ast.Load()), given, []))


def _told(value: object, comment: str, printed: bool) -> None:
    if printed:
        assert str(value) == comment, f"prints {value}, the page says {comment}"
        return
    try:
        expected = eval(comment.split(": ")[0] if comment[0] != "{" else comment, {"range": range})
    except (SyntaxError, NameError):
        return  # It explains the line.
    assert value == expected, f"is {value!r}, the page says {comment}"
