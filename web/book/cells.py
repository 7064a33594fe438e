"""Run a notebook as far as its widget, and no cell that the widget does without.

Reads the code cells of a notebook; gives the widget that one of them shows. The frames of a page
without a kernel are drawn from it (`frames.py`). A cell is needed if it makes, or changes, a name
that a needed cell after it uses.
"""

import ast
from collections.abc import Sequence
from typing import Any


def uses(node: ast.AST) -> set[str]:
    """Return the names that code looks up."""
    return {
        one.id
        for one in ast.walk(node)
        if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Load)
    }


def makes(node: ast.AST) -> set[str]:
    """Return the names that code binds, and those of what it may change."""
    names: set[str] = set()
    for one in ast.walk(node):
        if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store):
            names.add(one.id)
        elif isinstance(one, ast.FunctionDef | ast.ClassDef):
            names.add(one.name)
        elif isinstance(one, ast.Import | ast.ImportFrom):
            names |= {(alias.asname or alias.name).split(".")[0] for alias in one.names}
        elif isinstance(one, ast.Attribute | ast.Subscript):
            changed = isinstance(one.ctx, ast.Store)
            if changed and isinstance(one.value, ast.Name):
                names.add(one.value.id)
        elif isinstance(one, ast.Expr) and isinstance(one.value, ast.Call):
            function = one.value.func  # a call whose value is dropped is made for what it changes
            names |= uses(function) if isinstance(function, ast.Attribute) else set()
            names |= {name for argument in one.value.args for name in uses(argument)}
    return names


def needed(cells: Sequence[str], last: int) -> list[int]:
    """Return which cells have to run before cell `last` can, in order, that one included."""
    trees = [ast.parse(cell) for cell in cells[: last + 1]]
    wanted, chosen = uses(trees[last]), [last]
    for number in reversed(range(last)):
        if makes(trees[number]) & wanted:
            wanted |= uses(trees[number])
            chosen.append(number)
    return chosen[::-1]


def run(cells: Sequence[str], last: int) -> Any:
    """Run what cell `last` needs, and the cell; return the value of its last line."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for number in needed(cells, last)[:-1]:
        exec(compile(cells[number], f"<cell {number}>", "exec"), names)
    tree = ast.parse(cells[last])
    shown = tree.body.pop()
    if not isinstance(shown, ast.Expr):
        raise ValueError(f"cell {last} shows nothing on its last line")
    exec(compile(tree, f"<cell {last}>", "exec"), names)
    return eval(compile(ast.Expression(shown.value), f"<cell {last}>", "eval"), names)
