"""Checking values that come from outside: settings of a command, and records read from files.

Reads dataclasses whose fields say by their type what they may hold, such as `Annotated[int,
Ge(1)]`; gives the values back, or an error that names the field, its range and what came. A float
must be finite unless its field says otherwise (`Unbounded`). The types are annotated-types'.
"""

import inspect
import io
import json
import re
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import field, fields, is_dataclass, make_dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from annotated_types import Ge, Gt, Interval
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError

from fgtutor.errors import ConfigError, FgtutorError

T = TypeVar("T")

NAME = re.compile(r"\w(?:[\w .+-]{0,98}[\w+-])?")
"""What a name may be; it then reads alike in a path, a table, a picture and on a terminal."""


def _named(text: str) -> str:
    if not NAME.fullmatch(text):
        raise ValueError(
            "a name is up to 100 letters, digits, spaces and _ . + -, letters or digits at its ends"
        )
    return text


def _ascending(values: tuple) -> tuple:
    if any(low > high for low, high in pairwise(values)):
        raise ValueError("should not fall from one to the next")
    return values


def _once(values: tuple) -> tuple:
    if twice := [value for i, value in enumerate(values) if value in values[:i]]:
        raise ValueError(f"give each only once, {twice[0]!r} is there twice")
    return values


Count = Annotated[int, Interval(ge=1, le=10**9)]
"""A number of things, at least one."""
CountOrZero = Annotated[int, Interval(ge=0, le=10**9)]
"""A number of things, or 0, of which the field says what it means."""
Seed = Annotated[int, Interval(ge=0, le=2**32 - 1)]
"""What random numbers follow from; numpy, torch and Python all take these."""
Share = Annotated[float, Interval(ge=0, le=1)]
"""A part of a whole, from 0 to 1."""
Positive = Annotated[float, Gt(0)]
"""A finite number above 0."""
NonNegative = Annotated[float, Ge(0)]
"""A finite number from 0."""
Unbounded = Annotated[float, Gt(0), Field(allow_inf_nan=True)]
"""A number above 0, or infinity for no limit."""
Width = Annotated[int, Interval(ge=1, le=100_000)]
"""How many numbers a vector has, or a layer of a network."""
Name = Annotated[str, AfterValidator(_named)]
"""What something is called; see `NAME`."""
Unique = AfterValidator(_once)
"""No value of a tuple comes twice: `Annotated[tuple[str, ...], Unique]`."""
Ascending = AfterValidator(_ascending)
"""Numbers that do not fall: `Annotated[tuple[Positive, Positive], Ascending]`."""
LARGEST_RECORD = 20_000_000
"""Bytes of the largest record that is read; a specialist's description has forty thousand."""

_FINITE = ConfigDict(strict=True, allow_inf_nan=False)


def check_fields(config: Any, error: type[FgtutorError] = ConfigError) -> None:
    """Raise `error` unless every number and choice of a dataclass is what its type allows.

    A dataclass calls this in `__post_init__`, so that its values are checked however it is built.
    """
    check_arguments(type(config), vars(config), error)


def check_arguments(
    function: Callable[..., Any], given: Mapping[str, Any], error: type[FgtutorError]
) -> None:
    """Raise `error` unless every number and choice in `given` is what the function's types allow.

    A function calls this first, with itself and `locals()`.
    """
    for name, adapter in _numeric_fields(function).items():
        try:
            adapter.validate_python(_plain(given[name]))
        except ValidationError as problem:
            raise error(f"{name}: {_first(problem)}") from None


def numbers(
    name: str, values: Any, error: type[FgtutorError], *, unknown: bool = False
) -> np.ndarray:
    """Return an array, tensor or nested list of real numbers as a numpy array.

    They must be finite, unless some may be unknown: then NaN is allowed, masked values become NaN,
    and whole numbers floats. Raises `error`, which says `name`.
    """
    try:
        with np.errstate(all="ignore"):
            # A list of masked rows keeps its masks only so.
            array: Any = np.ma.asarray(detached(values))
    except Exception as problem:  # whatever a foreign type raises
        raise error(f"{name} is no array of numbers: {problem}") from None
    if array.dtype.kind not in ("fiu" if unknown else "fiub"):
        raise error(f"{name} holds {array.dtype}, expected real numbers")
    if unknown:
        return (array if array.dtype.kind == "f" else array.astype(np.float64)).filled(np.nan)
    if np.ma.is_masked(array):
        raise error(f"{name} has masked values: give each a number first (numpy.ma.filled)")
    if not np.isfinite(array.data).all():
        raise error(f"{name} holds NaN or infinity: check the Feasibility-Nets that it came from")
    return array.data


def detached(values: Any) -> Any:
    """Return a tensor without its device and its gradient, anything else as it is."""
    return values.detach().cpu() if hasattr(values, "detach") else values


def parse_options(kind: type[T], words: Sequence[str], program: str, default: T | None = None) -> T:
    """Return the `kind` that a command line's words fill, from `default` if there is one.

    Raises what `kind` itself does for a value that it refuses. Words that are no options, or no
    numbers, end the program with a message, as `--help` does.
    """
    import tyro  # here: only command lines need it

    said = io.StringIO()
    options: dict[str, Any] = {} if default is None else {"default": default}
    try:
        with redirect_stderr(said):
            return tyro.cli(kind, args=words, prog=program, **options)
    except SystemExit as stop:
        cause: BaseException | None = stop
        while cause := cause.__context__:  # tyro draws a box around what the dataclass raises
            if isinstance(cause, FgtutorError):
                raise cause from None
        sys.stderr.write(said.getvalue())
        raise


def parse_record(
    kind: type[T], data: bytes | str | Mapping[str, Any], error: type[FgtutorError], source: str
) -> T:
    """Return `data`, JSON or what JSON gave, as a `kind` (a dataclass or a type such as list[int]).

    A missing or unknown key, a number of another type or out of range and a text where a number is
    expected are refused, here and in every dataclass within. Raises `error`, which names `source`.
    """
    # Of Python's values pydantic reads a dataclass only if it may also take "1" for 1.
    try:
        text = data if isinstance(data, bytes | str) else json.dumps(data)
    except (TypeError, ValueError, RecursionError) as problem:
        raise error(f"{source} is not JSON: {problem}") from None
    if len(text) > LARGEST_RECORD:
        raise error(f"{source} has {len(text)} bytes, more than {LARGEST_RECORD}")
    try:
        return _record(kind).validate_json(text)
    except ValidationError as problem:
        raise error(f"{source}: {_first(problem)}") from None


def read_record(kind: type[T], path: str | Path, error: type[FgtutorError]) -> T:
    """Return what a JSON file holds, as `parse_record`; raises `error` if it cannot be read too."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST_RECORD + 1)
    except OSError as problem:
        raise error(f"cannot read {path}: {problem.strerror or problem}") from problem
    return parse_record(kind, data, error, str(path))


@cache
def arguments(kind: type, base: type = object) -> type:
    """Return a record of what a class takes beyond `base`: its arguments that are numbers.

    So a file can say how to build it, and nothing else; `Literal` words count as numbers here. What
    is None by default may be missing.
    """
    known = inspect.signature(base).parameters
    optional = {k for k, v in inspect.signature(kind).parameters.items() if v.default is None}
    hints = {}
    for part in kind.__mro__:
        if part is not base and issubclass(part, base) and "__init__" in part.__dict__:
            own = get_type_hints(part.__init__, include_extras=True)
            hints = {k: v for k, v in own.items() if k not in known and _is_plain(v)} | hints
    members = ((k, v, field(default=None) if k in optional else field()) for k, v in hints.items())
    return make_dataclass(kind.__name__, members, frozen=True, kw_only=True)


@cache
def _numeric_fields(kind: Callable[..., Any]) -> dict[str, TypeAdapter]:
    """Return a checker for each field or argument that is made of numbers or chosen words."""
    hints = get_type_hints(kind, include_extras=True)
    names = (
        [f.name for f in fields(kind)] if is_dataclass(kind) else inspect.signature(kind).parameters
    )
    return {
        name: TypeAdapter(hints[name], config=_FINITE)
        for name in names
        if name in hints and _is_plain(hints[name])
    }


def _is_plain(hint: Any) -> bool:
    """Tell whether a type is made of numbers, choices, None and their tuples, or checked words."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _is_plain(inner[0]) or inner[0] in (str, tuple[str, ...], tuple[Name, ...])
    if origin is Literal:
        return True
    if origin in (Union, types.UnionType, tuple):
        return all(_is_plain(part) for part in inner if part not in (Ellipsis, types.NoneType))
    return hint in (int, float, bool)


def _plain(value: Any) -> Any:
    """Return numpy's numbers as Python's, and a list as the tuple that a field holds."""
    if isinstance(value, np.generic):
        return value.item()
    return tuple(_plain(part) for part in value) if isinstance(value, tuple | list) else value


@cache
def _record(kind: Any) -> TypeAdapter:
    """Return the reader of a type, which refuses unknown keys in every dataclass."""
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return TypeAdapter(kind, config=_FINITE)
    if "__pydantic_config__" not in kind.__dict__:
        kind.__pydantic_config__ = ConfigDict(**_FINITE, extra="forbid")  # type: ignore
        for hint in get_type_hints(kind).values():
            for part in (hint, *get_args(hint)):
                if is_dataclass(part):
                    _record(part)
    return TypeAdapter[Any](kind)


def _first(problem: ValidationError) -> str:
    """Return what is wrong first, and where, in one line."""
    one = problem.errors(include_url=False, include_context=False)[0]
    where = ascii(".".join(str(part) for part in one["loc"]))[1:-1]
    came = re.sub(r"\s+", " ", repr(one["input"]))
    came = came if len(came) <= 60 else f"{came[:57]}..."
    what = one["msg"].replace("Input should", "should").removeprefix("Value error, ")
    text = f"{what[:1].lower()}{what[1:]}, got {came}"
    return f"{where}: {text}" if where else text
