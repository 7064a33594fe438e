"""The source of what a learner wrote, with all that it needs, so that it runs on its own.

Reads a function, a class or a number from a notebook; gives lines of Python. What the source names
is looked up among the notebook's variables: modules become imports, plain values assignments, and
functions and classes of the learner's are taken along, with what they need in turn.
"""

import ast
import builtins
import inspect
import linecache
import math
import os
import symtable
import sys
import types
from collections.abc import Iterator
from typing import Any

import numpy as np

from fgtutor.errors import ConfigError

MOST = 200
"""Values of an array that is kept as a constant; a file of answers is no place for data."""
PLAIN = (bool, int, float, complex, str, bytes, type(None), type(...))


def source_of(name: str, value: Any) -> str:
    """Return statements after which `name` is `value`, without the notebook that it comes from.

    Raises:
        ConfigError: Its source cannot be had, or it needs something that has none.
    """
    found = _Found()
    found.take(name, value, "the answer")
    imports = sorted(found.imports, key=lambda line: (line.startswith("from"), line))
    groups = ["\n".join(imports), "\n".join(found.constants), *found.definitions]
    return "\n\n\n".join(filter(None, groups)) + "\n"


class _Found:
    """What was found so far, in the order in which it has to run."""

    def __init__(self) -> None:
        self.imports: dict[str, None] = {}
        self.constants: list[str] = []
        self.definitions: list[str] = []
        self.taken: dict[str, Any] = {}

    def take(self, name: str, value: Any, needed_by: str) -> None:
        """Take one variable; raises `ConfigError` if nothing that can be written gives it."""
        if name in self.taken:
            if self.taken[name] is not value:
                raise ConfigError(f"`{name}` means two things in it: rename one of them")
            return
        self.taken[name] = value
        if isinstance(value, types.ModuleType):
            same = value.__name__ == name
            self.imports[f"import {value.__name__}" + ("" if same else f" as {name}")] = None
        elif module := _home(name, value):
            own = getattr(value, "__name__", name)
            original = own if vars(sys.modules[module]).get(own) is value else name
            renamed = "" if original == name else f" as {name}"
            self.imports[f"from {module} import {original}{renamed}"] = None
        elif inspect.isfunction(_original(value)) or inspect.isclass(value):
            self._define(name, value)
        else:
            self.constants.append(f"{name} = {self._literal(name, value, needed_by)}")

    def _define(self, name: str, value: Any) -> None:
        original = _original(value)
        own = original.__name__
        source = definition(original)
        tree = ast.parse(source)
        globals_of = _globals(original)
        for needed in _free_names(source):
            if needed in globals_of:
                self.take(needed, globals_of[needed], f"`{own}`")
            elif not hasattr(builtins, needed) and needed not in ("__class__", "__name__"):
                raise ConfigError(f"`{own}` uses `{needed}`, which is not defined: define it first")
        for module in _submodules(tree, globals_of):
            self.imports[f"import {module}"] = None
        self.definitions.append(source)
        if name != own:
            self.taken[own] = value
            self.definitions.append(f"{name} = {own}")

    def _literal(self, name: str, value: Any, needed_by: str) -> str:
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, np.ndarray) and value.size <= MOST and value.dtype.kind in "biuf":
            self.imports["import numpy"] = None
            return f"numpy.array({_written(value.tolist())}, dtype={value.dtype.name!r})"
        text = _written(value)
        if not _is_plain(value) or len(text) > 100 * MOST:
            raise ConfigError(
                f"{needed_by} uses `{name}`, a {type(value).__name__} from elsewhere in the "
                "notebook: give it as an argument, or make it inside the function"
            )
        return text


def definition(value: Any) -> str:
    """Return the `def` or `class` statement of a function or class, as it was written.

    Raises:
        ConfigError: There is no source, or it is no statement of its own, as of a lambda.
    """
    own = value.__name__
    if own == "<lambda>":
        raise ConfigError("it is a lambda: write it as `def`, at the beginning of a line")
    if inspect.isfunction(value) and value.__closure__:
        around = [name for name in value.__code__.co_freevars if name != "__class__"]
        raise ConfigError(
            f"`{own}` is defined inside a function and uses its {', '.join(around)}: define it at "
            "the beginning of a line"
        )
    file, line = _place(value)
    linecache.checkcache(file)
    lines = linecache.getlines(file)
    try:
        tree = ast.parse("".join(lines))
    except SyntaxError as error:  # a cell with IPython's own syntax
        raise ConfigError(
            f"the cell of `{own}` holds more than Python (line {error.lineno}): define it in a "
            "cell without `%` and `!`"
        ) from error
    found = [
        node
        for node in tree.body
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
        and node.name == own
        and (line is None or _first(node) <= line <= (node.end_lineno or line))
    ]
    if not found:
        raise ConfigError(
            f"the source of `{own}` cannot be had: define it in a cell, at the beginning of a line"
        )
    return "".join(lines[_first(found[-1]) - 1 : found[-1].end_lineno]).rstrip()


def _original(value: Any) -> Any:
    """Return what decorators such as `lru_cache` were wrapped around; a class as it is."""
    return inspect.unwrap(value) if callable(value) and not inspect.isclass(value) else value


def _first(node: ast.FunctionDef | ast.ClassDef) -> int:
    """Return the first line of a definition, its decorators included."""
    return min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])


def _place(value: Any) -> tuple[str, int | None]:
    """Return the file that a function or class was written in, and a line of it if known.

    A class of a notebook has no file of its own; those of its methods that were written have.
    """
    if inspect.isfunction(value):
        return value.__code__.co_filename, value.__code__.co_firstlineno
    for method in vars(value).values():
        code = getattr(_original(method), "__code__", None)
        if code and linecache.getlines(code.co_filename):
            return code.co_filename, code.co_firstlineno
    raise ConfigError(f"the source of the class `{value.__name__}` cannot be had: give it a method")


def _globals(value: Any) -> dict[str, Any]:
    """Return the variables of the notebook that a function or class was defined in."""
    if inspect.isfunction(value):
        return value.__globals__
    file, _ = _place(value)
    for method in vars(value).values():
        original = _original(method)
        if inspect.isfunction(original) and original.__code__.co_filename == file:
            return original.__globals__
    return {}


def _home(name: str, value: Any) -> str:
    """Return the module that offers a value; "" for the learner's own, also from a file beside.

    What a grader offers comes first, then the module that says so itself.
    """
    if isinstance(value, PLAIN) or (isinstance(value, tuple | list | dict) and _is_plain(value)):
        return ""
    said = getattr(value, "__module__", None)
    places = ["fgtutor.directions", said if isinstance(said, str) else ""]
    if not (inspect.isfunction(value) or inspect.isclass(value)):
        places += [module for module in [*sys.modules] if not module.startswith(("_", "fgtutor"))]
    for place in filter(None, places):
        module = sys.modules.get(place)
        if module is None or place == "__main__" or not getattr(module, "__spec__", None):
            continue
        for offered in (getattr(value, "__name__", name), name):
            if isinstance(offered, str) and vars(module).get(offered) is value:
                beside = os.path.dirname(getattr(module, "__file__", None) or "") == os.getcwd()
                return "" if beside else place
    return ""


def _free_names(source: str) -> list[str]:
    """Return the names that a definition takes from around it, in order."""

    def walk(table: symtable.SymbolTable) -> Iterator[str]:
        outermost = table.get_type() == "module"
        for symbol in table.get_symbols():
            own = outermost and symbol.is_assigned()
            if symbol.is_referenced() and not own and (outermost or symbol.is_global()):
                yield symbol.get_name()
        for child in table.get_children():
            yield from walk(child)

    table = symtable.symtable(source, "<answer>", "exec")
    own = {symbol.get_name() for symbol in table.get_symbols() if symbol.is_assigned()}
    return [name for name in dict.fromkeys(walk(table)) if name not in own]


def _submodules(tree: ast.Module, variables: dict[str, Any]) -> Iterator[str]:
    """Yield the modules that code reaches through a package, as in `scipy.sparse.csgraph`."""
    for node in ast.walk(tree):
        names: list[str] = []
        while isinstance(node, ast.Attribute):
            names.insert(0, node.attr)
            node = node.value
        value = variables.get(node.id) if isinstance(node, ast.Name) else None
        for name in names:
            inner = getattr(value, name, None) if isinstance(value, types.ModuleType) else None
            if not isinstance(inner, types.ModuleType):
                break
            if inner.__name__.endswith(f".{name}"):
                yield inner.__name__
            value = inner


def _is_plain(value: Any) -> bool:
    """Return whether a value can be written down: a number, a text, or a collection of these."""
    if type(value) in (tuple, list, set, frozenset):
        return all(map(_is_plain, value))
    if type(value) is dict:
        return all(_is_plain(item) for pair in value.items() for item in pair)
    return type(value) in PLAIN


def _written(value: Any) -> str:
    """Return a plain value as Python reads it, infinity and NaN included."""
    if isinstance(value, float) and not math.isfinite(value):
        return f'float("{value}")'
    if type(value) is list:
        return f"[{', '.join(map(_written, value))}]"
    if type(value) is tuple:
        return f"({', '.join(map(_written, value))}{',' * (len(value) == 1)})"
    if type(value) is dict:
        return f"{{{', '.join(f'{_written(k)}: {_written(v)}' for k, v in value.items())}}}"
    return repr(value)
