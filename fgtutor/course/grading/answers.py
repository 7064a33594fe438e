"""Answers as plain values: how they pass from one process to another, and how two of them differ.

Reads numbers, text, arrays and lists of these; gives JSON, never a pickle, and text that shows what
differs. What does not reduce to plain numbers is refused, so an object with opinions about `==` is
an array by the time anything is compared.
"""

import base64
import sys
from typing import Any

import numpy as np

from fgtutor.directions import NAMES, NUM_HEADINGS
from fgtutor.errors import ConfigError

LARGEST = 200_000
"""Most bytes of numbers in one answer."""
DEEPEST = 4
"""Lists within lists in one answer: enough for any, and no recursion to exhaust."""
ROWS = 5
"""Differing values shown in a table."""
PICTURE = 64, 20
"""Largest picture of where an array differs, columns and rows of text."""
SINGLE = 1e-4, 1e-6
"""Tolerances of an answer in float32: relative, and absolute as a share of the largest value."""
_DTYPES = {"b": "bool", "i": "int64", "u": "uint64", "f": "float64"}


def encode(value: Any, room: int = DEEPEST, *, tensors: bool = False) -> Any:
    """Return a value as JSON can hold it; raises `ConfigError` if it is not a plain one.

    A tensor of torch becomes an array; with `tensors` it is marked, for `decode` to restore it.
    """
    if _is_plain(value):
        return value
    if isinstance(value, tuple | list):
        if not room:
            raise ConfigError(f"lists within lists, more than {DEEPEST} deep")
        kind = "tuple" if isinstance(value, tuple) else "list"
        return {kind: [encode(item, room - 1, tensors=tensors) for item in value]}
    if isinstance(value, int):
        raise ConfigError(f"{describe(value)}, more than 64")
    tensor = _is_tensor(value)
    try:
        array = np.asarray(arrays_of(value))
    except Exception as error:  # whatever a foreign object's own conversion raises
        raise ConfigError(f"a {_kind(value)} that is no array: {error!r:.80}") from error
    if array.dtype.kind not in _DTYPES:
        raise ConfigError(f"a {_kind(value)}, not numbers: return arrays or numbers")
    single = array.dtype.kind == "f" and array.dtype.itemsize <= 4
    stored = "float32" if single else _DTYPES[array.dtype.kind]
    array = np.ascontiguousarray(array, dtype=stored).reshape(array.shape)
    if array.nbytes > LARGEST:
        raise ConfigError(f"an array of shape {array.shape}, larger than any answer should be")
    data = base64.b64encode(array.tobytes()).decode()
    kind = "tensor" if tensor and tensors else "array"
    return {kind: [array.dtype.name, list(array.shape), data]}


def decode(data: Any, room: int = DEEPEST, *, tensors: bool = False) -> Any:
    """Return what `encode` was given; raises `ConfigError` for what it cannot have made.

    Tensors are made only with `tensors`, which loads torch: for cases, which are ours.
    """
    if _is_plain(data):
        return data
    try:
        ((kind, content),) = data.items()
        if not isinstance(content, list):
            raise ValueError(f"{kind!r:.40} of no list")
        if kind in ("tuple", "list") and room:
            items = [decode(item, room - 1, tensors=tensors) for item in content]
            return tuple(items) if kind == "tuple" else items
        name, shape, text = content
        kinds = ("array", "tensor") if tensors else ("array",)
        if kind not in kinds or name not in (*_DTYPES.values(), "float32"):
            raise ValueError(f"neither a shallow list nor an array of numbers: {kind!r:.40}")
        if any(type(length) is not int or length < 0 for length in shape):
            raise ValueError(f"an array of shape {shape!r:.40}")
        array = np.frombuffer(base64.b64decode(text), dtype=name).reshape(shape).copy()
        if kind == "tensor":
            import torch

            return torch.from_numpy(array)
        return array
    except (ArithmeticError, AttributeError, TypeError, ValueError) as error:
        raise ConfigError(f"not an encoded value ({error})") from error


def difference(
    expected: Any,
    got: Any,
    *,
    rtol: float = 1e-5,
    atol: float = 1e-8,
    show: bool = True,
    single: bool = True,
) -> str:
    """Say how `got` differs from `expected`: a table and, for maps, a picture; "" if it does not.

    Integers, floats and booleans of one value are the same, and so are a number and an array that
    holds only it. With `single` an answer in float32 may be as far off as float32 is. Without
    `show` nothing is said that follows from the expected values, but for how many there are.
    """
    if got is None:
        return "The function returned None: does it end with `return`?"
    if isinstance(expected, tuple):
        array = isinstance(got, np.ndarray) and got.ndim
        items = list(got) if array or isinstance(got, tuple | list) else []
        if len(items) != len(expected):
            return f"Expected {len(expected)} values, got {describe(got)}."
        for i, (one, other) in enumerate(zip(expected, items, strict=True)):
            text = difference(one, other, rtol=rtol, atol=atol, show=show, single=single)
            if text:
                return f"In value {i + 1} of the {len(expected)} returned:\n{text}"
        return ""
    wanted, array = np.asarray(expected), _numbers(got)
    asked = describe(expected) if show else "a number" if wanted.ndim == 0 else "an array"
    if array is None:
        return f"Expected {asked}, got {describe(got)}."
    if wanted.ndim == 0 and array.size == 1:
        array = array.reshape(())
    if array.shape != wanted.shape:
        turned = sorted(array.shape) == sorted(wanted.shape)
        advice = ": are two axes swapped?" if turned and show else "."
        return f"Expected {asked}, got {describe(got)}{advice}"
    if single and array.dtype == np.float32:
        largest = np.max(np.abs(wanted), where=np.isfinite(wanted), initial=0.0)
        rtol, atol = max(rtol, SINGLE[0]), max(atol, SINGLE[1] * float(largest))
    wrong = ~np.isclose(array, wanted, rtol=rtol, atol=atol, equal_nan=True)
    if not wrong.any():
        return ""
    if not show:
        return f"Got {_number(array[wrong][0])}." if wanted.ndim == 0 else "Some values differ."
    return _table(wanted, array, wrong) + _picture(wrong)


def not_integers(value: Any) -> str:
    """Say which numbers in a value are not of an integer type; "" if all are."""
    if isinstance(value, tuple | list):
        return next(filter(None, map(not_integers, value)), "")
    array = _numbers(value)
    if array is None or array.dtype.kind in "iub":
        return ""
    return f"Expected integers, got numbers of type {array.dtype}: end with `.astype(int)`."


def arrays_of(value: Any) -> Any:
    """Return a value with an array in place of each tensor of torch."""
    if isinstance(value, tuple | list):
        return type(value)(map(arrays_of, value))
    return value.detach().cpu().numpy() if _is_tensor(value) else value


def describe(value: Any) -> str:
    """Return what kind of value this is, in few words."""
    if _is_tensor(value):
        return f"a tensor of shape {tuple(value.shape)}"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    if isinstance(value, tuple | list):
        if 0 < len(value) <= 4 and all(_is_number(item) for item in value):
            return f"({', '.join(map(_number, value))})"
        inside = ", ".join(describe(item) for item in value[:3]) + ", ..." * (len(value) > 3)
        return f"{len(value)} values ({inside})" if value else "an empty list"
    if isinstance(value, str):
        return f"the text {value[:40]!r}"
    if isinstance(value, int) and not _is_plain(value):
        return f"an integer of {value.bit_length()} bits"
    if isinstance(value, bool | int | float | np.generic):
        return f"the number {_number(value)}"
    return _kind(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, float | np.generic) or (isinstance(value, int) and _is_plain(value))


def _is_plain(value: Any) -> bool:
    """Return whether JSON holds a value as it is; an integer only if 64 bits hold it."""
    if isinstance(value, int):
        return -(2**63) <= value < 2**63
    return value is None or isinstance(value, float | str)


def _is_tensor(value: Any) -> bool:
    """Return whether a value is a tensor of torch, without loading torch to find out."""
    torch = sys.modules.get("torch")
    return isinstance(value, getattr(torch, "Tensor", ()))


def _kind(value: Any) -> str:
    return "nothing (None)" if value is None else type(value).__name__


def _numbers(value: Any) -> np.ndarray | None:
    """Return a value as an array of numbers, or None if it is not one."""
    if not _is_numeric(value):  # with a text among them, numpy would make all as wide as that
        return None
    try:
        return np.asarray(value)
    except ValueError:  # rows of different lengths
        return None


def _is_numeric(value: Any) -> bool:
    """Return whether a value consists of numbers, each of which numpy holds in 8 bytes."""
    if isinstance(value, tuple | list):
        return all(map(_is_numeric, value))
    if isinstance(value, np.ndarray | np.generic):
        return value.dtype.kind in _DTYPES
    return isinstance(value, int | float) and _is_plain(value)


def _number(value: Any, digits: int = 4) -> str:
    return str(value) if isinstance(value, bool | np.bool_) else f"{value:.{digits}g}"


def _table(wanted: np.ndarray, array: np.ndarray, wrong: np.ndarray) -> str:
    """List the first values that differ."""
    if wanted.ndim == 0:
        rows = [("", _number(wanted[()]), _number(array[()]))]
        if rows[0][1] == rows[0][2]:
            rows = [("", _number(wanted[()], 10), _number(array[()], 10))]
        head = ""
    else:
        rows = []
        for index in np.argwhere(wrong)[:ROWS].tolist():
            pair = wanted[tuple(index)], array[tuple(index)]
            texts = [_number(value) for value in pair]
            if texts[0] == texts[1]:
                texts = [_number(value, 10) for value in pair]
            rows.append((str(index), *texts))
        head = f"{wrong.sum()} of {wrong.size} values differ" + (
            f", the first {ROWS}:\n" if wrong.sum() > ROWS else ":\n"
        )
    lines = [("where" if wanted.ndim else "", "expected", "got"), *rows]
    wide = [max(len(line[column]) for line in lines) for column in range(3)]
    return head + "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, wide, strict=True)).rstrip()
        for line in lines
    )


def _picture(wrong: np.ndarray) -> str:
    """Draw which cells of a map differ, x to the right and y up; nothing for small arrays.

    Of several layers, such as the headings of a tensor, the one with the most wrong cells is drawn.
    """
    if wrong.ndim < 2 or min(wrong.shape[:2]) < 3:
        return ""
    layers = wrong.reshape(*wrong.shape[:2], -1)
    worst = int(layers.sum(axis=(0, 1)).argmax())
    plane = layers[: PICTURE[0], : PICTURE[1], worst]
    # Text runs row by row from above: transpose, highest y first.
    rows = ["".join("x" if cell else "." for cell in row) for row in plane.T[::-1]]
    which = ""
    if wrong.ndim == 3:
        count = wrong.shape[2]
        name = f"heading {worst} ({NAMES[worst]})" if count == NUM_HEADINGS else "the layer"
        which = f" of {name}, [:, :, {worst}], which has the most of all {count}"
    return (
        f"\nWrong cells{which}. x is wrong, . is right; first axis to the right, second up:\n"
        + "\n".join(rows)
    )
