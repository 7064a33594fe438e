"""Point clouds as text: lines of numbers, with or without names above them.

Reads .xyz files, and the lines of numbers in PLY and PCD files; gives coordinates. There is no
standard, so whatever the file says is obeyed (names of columns, a number of points), and what
cannot be told is refused with the number of the line.
"""

import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

import numpy as np

from fgtutor.errors import CloudError
from fgtutor.io.cloud import Cloud, Points, check_count, cloud_of, whole_number

_BLOCK = 100_000
"""Lines that are read at a time."""
_AXES = {
    "x": ("x", "easting", "east"),
    "y": ("y", "northing", "north"),
    "z": ("z", "height", "elevation", "altitude"),
}
"""What a coordinate may be called, capitals or not."""
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*|,\d+)?|[.,]\d+)([eE][-+]?\d+)?")
_NOTHING = re.compile(r"[-+]?(nan(\(\w*\))?|\d?\.#\w+|inf(inity)?|n/?a|null|none|-)", re.IGNORECASE)
"""How programs write that there is no number."""
_COMMENT = re.compile(r"(?:^|(?<=\s))(?:#|//|%)")
_UNIT = re.compile(r"(.+?)(?:\s*[\[(]\s*([^\])]*?)\s*[\])]|_(m|cm|mm|km|ft|us_?ft|deg))")


def read_xyz(path: Path) -> Cloud:
    """Return the points of a text file: the columns that its header names, or the first three.

    Raises:
        CloudError: A line has no numbers where they are expected, other columns than the one
            before, or it cannot be told which column is what.
    """
    with path.open("rb") as raw:
        marked = raw.read(2) in (b"\xff\xfe", b"\xfe\xff")
    encoding = "utf-16" if marked else "utf-8-sig"
    # Comments come in any encoding; the numbers are read alike in all of them.
    with path.open(encoding=encoding, errors="surrogateescape") as lines:
        head: list[str] = []
        names = promised = None
        number = 0
        for line in lines:
            number += 1
            words = line.replace('"', " ").replace(",", " ").replace(";", " ").split()
            numbers = sum(map(_is_number, words))
            if not words:
                continue
            if _COMMENT.match(words[0]):
                head.append(_COMMENT.split(line.strip(), maxsplit=1)[-1].strip("#/% "))
            elif names is None and numbers < min(3, len(words)):
                names = line.strip()
            elif promised is None and len(words) == 1 and words[0].isdecimal():
                promised = whole_number(words[0], "the number of points")
            else:
                break
        else:
            raise CloudError("the file holds no line of numbers; expected x y z in metres")
        plain = _COMMENT.split(line, maxsplit=1)[0]
        separator = _separator(plain)
        width = len(_fields(plain, separator))
        if width < 3:
            raise CloudError(
                f"line {number} has {width} columns, expected x y z: {line.strip()[:60]!r}; "
                "copy or export it again"
            )
        columns = _named(names, head, separator, width)
        if columns is None:
            columns = (0, 1, 2)
            if separator == "," and width > 3 and all(w.lstrip("+-").isdecimal() for w in words):
                raise CloudError(
                    f"line {number} may hold decimal commas or {width} columns of whole numbers: "
                    "write decimal points, or name the columns in a line above"
                )
        points = read_table(chain([line], lines), number, columns, width, separator)
    if promised is not None:
        check_count(len(points), promised)
    return cloud_of(points)


def read_table(
    lines: Iterable[str],
    number: int,
    columns: Sequence[int],
    width: int,
    separator: str | None = None,
) -> Points:
    """Return three of the columns of lines of numbers; empty lines and comments are left out.

    Args:
        lines: The lines.
        number: The number of the first line in its file.
        columns: Which columns are x, y and z.
        width: How many columns there are.
        separator: What stands between them; None stands for blanks.

    Raises:
        CloudError: A line has another number of columns, or no number in one of the three.
    """
    lines, tables = iter(lines), []
    while block := list(islice(lines, _BLOCK)):
        if separator != ",":
            block = [line.replace(",", ".") for line in block]
        try:
            with warnings.catch_warnings(action="ignore"):  # that all lines are empty
                table = np.loadtxt(
                    block, delimiter=separator, comments=None, quotechar='"', ndmin=2
                )
        except ValueError:
            table = None
        if table is None or (len(table) and table.shape[1] != width):
            # Slower, but it knows more words, and the number of the line that is at fault.
            rows = list(_rows(block, number, columns, width, separator))
            tables.append(np.array(rows, dtype=np.float64).reshape(-1, 3))
        elif len(table):
            tables.append(table[:, columns])
        number += len(block)
    return np.concatenate(tables) if tables else np.empty((0, 3))


def _rows(
    lines: list[str], start: int, columns: Sequence[int], width: int, separator: str | None
) -> Iterator[list[float]]:
    for number, line in enumerate(lines, start):
        fields = _fields(_COMMENT.split(line, maxsplit=1)[0], separator, width)
        if not fields:
            continue
        if len(fields) != width:
            raise CloudError(
                f"line {number} has {len(fields)} columns, expected {width}: {line.strip()[:60]!r}"
            )
        row = [fields[column] for column in columns]
        for text in row:
            if not _is_number(text):
                raise CloudError(f"line {number}: {text[:40]!r} is no number")
        yield [float(text) if _NUMBER.fullmatch(text) else np.nan for text in row]


def _fields(line: str, separator: str | None, width: int = 0) -> list[str]:
    """Return the columns of a line without blanks and quotes; a separator may end it."""
    fields = [field.strip().strip("\"'") for field in line.strip().split(separator)]
    return fields[:-1] if fields and not fields[-1] and len(fields) != width else fields


def _is_number(text: str) -> bool:
    return bool(_NUMBER.fullmatch(text) or _NOTHING.fullmatch(text) or not text)


def _separator(line: str) -> str | None:
    """Return what stands between the columns of a line; None stands for blanks."""
    if ";" in line:
        return ";"
    words = line.split()
    if "," in line and not (len(words) >= 3 and all(map(_is_number, words))):
        return ","  # and otherwise commas are those of decimals
    return "\t" if line.count("\t") >= 2 else None


def _named(
    names: str | None, comments: list[str], separator: str | None, width: int
) -> tuple[int, ...] | None:
    """Return which columns the header calls x, y and z; None if it names none."""
    if names is not None:
        found = _split(names, separator)
        columns = _columns(found)
        if columns is None:
            raise CloudError(
                f"the header names the columns {names[:60]!r}, and none or several of them x, y or "
                "z: name them x, y and z, in metres"
            )
        if len(found) != width:
            raise CloudError(f"the header names {len(found)} columns, the lines have {width}")
        return columns
    for text in reversed(comments):
        found = _split(text, separator) if separator and separator in text else _split(text, None)
        if len(found) == width and any(n.startswith(("lon", "lat")) for n in found):
            raise CloudError(f"the columns {text[:60]!r} are degrees: project them to metres")
        columns = _columns(found)
        # Sentences, too, may speak of x, y and z.
        if columns and (len(found) == width or sorted(columns) == [0, 1, 2]):
            return columns
    return None


def _split(names: str, separator: str | None) -> list[str]:
    together = re.sub(r"\s+(?=[\[(])", "", names.lower())
    if separator is None or separator not in together:
        return [name.strip("\"'") for name in re.split(r"[\s,;]+", together) if name]
    return _fields(together, separator)


def _columns(names: list[str]) -> tuple[int, ...] | None:
    """Return where x, y and z stand, if each is there once; refuse other units than metres."""
    split = [_UNIT.fullmatch(name) for name in names]
    plain = [match[1].strip() if match else name for name, match in zip(names, split, strict=True)]
    columns = []
    for words in _AXES.values():
        where = [i for i, name in enumerate(plain) if name in words]
        if len(where) != 1:
            return None
        columns.append(where[0])
        unit = (match := split[where[0]]) and (match[2] or match[3])
        if unit and unit not in ("m", "metre", "metres", "meter", "meters"):
            raise CloudError(
                f"the header gives {plain[where[0]]} in {unit[:20]!r}: convert to metres"
            )
    return tuple(columns)
