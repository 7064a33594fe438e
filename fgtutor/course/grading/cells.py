"""Running cells as Jupyter runs them: IPython's own syntax, `await` at the top, and no shell.

Reads a cell's source and the namespace that all cells share. What IPython offers beside Python is
there and does nothing, but for the magics whose only purpose is to run code.
"""

import __future__

import ast
import inspect
import types
from functools import cached_property
from typing import Any

RUNNING = frozenset({"time", "capture", "prun"})
"""Magics that run their code in the notebook's namespace, as line or as cell."""


class Cells:
    """The cells of one notebook, which share a namespace."""

    def __init__(self, namespace: dict[str, Any]) -> None:
        self.namespace = namespace
        self._flags = ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
        shell = _Shell(self)
        namespace["get_ipython"] = lambda: shell

    def compiled(self, source: str, name: str) -> types.CodeType:
        """Compile one cell; raises what `compile` does."""
        code = compiled(source, name, self._flags)
        # A cell's `from __future__ import annotations` holds for those after it.
        self._flags |= code.co_flags & __future__.annotations.compiler_flag
        return code

    def run(self, code: types.CodeType) -> None:
        """Run one cell."""
        value = eval(code, self.namespace)
        if inspect.iscoroutine(value):  # it awaits something
            self._loop.run_until_complete(value)

    @cached_property
    def _loop(self) -> Any:
        """An event loop that needs no socket: those are for threads and signals to wake it."""
        import asyncio
        import selectors

        class Loop(asyncio.SelectorEventLoop):
            def _make_self_pipe(self) -> None: ...

            def _close_self_pipe(self) -> None: ...

        return Loop(selectors.SelectSelector())


def compiled(source: str, name: str, flags: int = ast.PyCF_ALLOW_TOP_LEVEL_AWAIT) -> types.CodeType:
    """Compile a cell; what is no Python becomes calls of `get_ipython()`, as in Jupyter."""

    def compile_as(mode: str, text: str) -> types.CodeType:
        return compile(text, name, mode, flags, dont_inherit=True)

    try:
        return compile_as("exec", source)
    except SyntaxError:
        from IPython.core.inputtransformer2 import TransformerManager

        return compile_as("exec", TransformerManager().transform_cell(source))


class _Shell:
    """What a cell sees of IPython's shell."""

    def __init__(self, cells: Cells) -> None:
        self._cells = cells

    def run_line_magic(self, name: str, line: str, *rest: Any) -> Any:
        """Run the code behind `%time`, whose value the cell may want; ignore other magics."""
        if name not in RUNNING:
            return None
        try:
            return eval(line, self._cells.namespace)
        except SyntaxError:  # a statement
            self.run_cell_magic(name, "", line)

    def run_cell_magic(self, name: str, line: str, cell: str) -> None:
        """Run the cell under `%%time`; ignore other magics, such as `%%bash`."""
        if name in RUNNING:
            self._cells.run(self._cells.compiled(cell, "<magic>"))

    def getoutput(self, *values: Any, **options: Any) -> list[str]:
        """Return the lines of a command's output: there is no command."""
        return []

    def __getattr__(self, name: str) -> Any:
        return lambda *values, **options: None
