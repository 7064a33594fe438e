"""How the fuzzer damages files: as bytes, as text, as trees (JSON, YAML) and as zip archives.

A damage takes a random state, a file and a second file of the same kind, and gives another file.
"""

import io
import json
import math
import random
import re
import struct
import zipfile
from collections.abc import Callable, Sequence
from typing import Any

Damage = Callable[[random.Random, bytes, bytes], bytes]

MARKER = "EXECUTED"
"""The folder that payloads in the files try to make where the fuzzer runs."""
INTEGERS = (0, 1, -1, 2, 255, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 10**9, 2**63 - 1, 2**63, -(2**63))
FLOATS = (0.0, 1e-320, -1.0, 1e10, 1e37, 1e308, -1e308, math.inf, -math.inf, math.nan)
WORDS = (
    *("", "0", "-1", "1", "0.5", "2147483647", "2147483648", "4294967296", "9223372036854775808"),
    *("1000000000", "1e999", "-1e999", "1e308", "1e-320", "nan", "inf", "-nan(ind)", "9" * 400),
    *("x" * 3000, "[" * 5000, "0x10", "1_0", "1,5", "\0", "\x1b[31m", "\u202e", "é", "%n%s"),
)
RAW = (
    *("null", "true", "false", "-1", "0", "1", "2", "0.5", "1e308", "-1e308", "1e999", "NaN"),
    *("-Infinity", "1e-320", "2147483648", "9223372036854775808", "9" * 400, "9" * 5000),
    *('""', '"NaN"', '"1"', '"\\ud800"', '"\\u0000"', '"\\u001b[31m"', f'"{"x" * 3000}"'),
    *('"os:mkdir"', "[]", "{}", "[[]]", "[1, 2]", "[null]", '{"a": 1}', f"[{'0,' * 20_000}0]"),
    *("[" * 5000 + "]" * 5000, '{"a":' * 5000 + "1" + "}" * 5000),
)
"""Values as JSON writes them, and some that Python cannot write."""


def place(rng: random.Random, length: int) -> int:
    """Choose a position, often near the beginning, where headers are."""
    return rng.randrange(min(max(length, 1), rng.choice((32, 128, 512, 2**40, 2**40))))


def number(rng: random.Random, size: int) -> bytes:
    """Return an extreme number of so many bytes, in one of the byte orders."""
    order = rng.choice("<>")
    if size >= 4 and rng.random() < 0.4:
        value = rng.choice(FLOATS)
        if size == 8 or not 1e38 < abs(value) < math.inf:
            return struct.pack(order + ("d" if size == 8 else "f"), value)
    return (rng.choice(INTEGERS) % 256**size).to_bytes(size, "little" if order == "<" else "big")


def poke(rng: random.Random, data: bytes, at: int, size: int) -> bytes:
    """Overwrite a field with an extreme number."""
    return data[:at] + number(rng, size) + data[at + size :]


def damage_bytes(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Flip a bit, cut, insert, remove, splice, blank, repeat, or overwrite a number."""
    at, count = place(rng, len(data)), rng.choice((1, 1, 2, 4, 8, 100, 1000))
    begin, middle, end = data[:at], data[at : at + count], data[at + count :]
    ways: tuple[Callable[[], bytes], ...] = (
        lambda: begin + bytes(b ^ 1 << rng.randrange(8) for b in middle[:1]) + data[at + 1 :],
        lambda: rng.choice((begin, data[:-count])),
        lambda: begin + rng.randbytes(count) + data[at:],
        lambda: begin + end,
        lambda: begin + other[place(rng, len(other)) :],
        lambda: begin + rng.choice((b"\0", b"\xff")) * count + end,
        lambda: begin + middle * 2 + end,
        lambda: poke(rng, data, at, rng.choice((1, 2, 4, 8))),
    )
    return rng.choice(ways)()


def damage_text(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Put another word or number in place of one, or move, repeat and remove lines."""
    if rng.random() < 0.5:
        # Headers are text even where what follows is not.
        pattern = rng.choice((rb"[-+]?[0-9.]+(?:[eE][-+]?\d+)?", rb"[^\s,:;=]+"))
        found = list(re.finditer(pattern, data[: rng.choice((300, 2000, 50_000))]))
        if not found:
            return damage_bytes(rng, data, other)
        hit = rng.choice(found)
        word = rng.choice((*(word.encode() for word in WORDS), rng.choice(found)[0]))
        return data[: hit.start()] + word + data[hit.end() :]
    lines = data.split(b"\n")
    i, j = (place(rng, len(lines)) for _ in range(2))
    match rng.randrange(5):
        case 0:
            del lines[i]
        case 1:
            lines[i], lines[j] = lines[j], lines[i]
        case 2:
            lines[i:i] = [lines[j]] * rng.choice((1, 1, 1000))
        case 3:
            lines[i] += rng.choice((b" ", b"\t", b",", b"\r", b";", b" 7", b" x" * 2000))
        case _:
            lines[i] = rng.choice((b"", b"#", b"comment x", rng.randbytes(20), b"\xef\xbb\xbfx"))
    return b"\n".join(lines)


def places(tree: Any) -> list[tuple[Any, Any]]:
    """Return container and key of every value within; of long lists, of some of their values."""
    found, left = [], [tree]
    while left:
        node = left.pop()
        keys = list(node) if isinstance(node, dict) else range(len(node))
        for key in keys if len(keys) < 50 else (*keys[:3], *keys[-2:]):
            found.append((node, key))
            if isinstance(node[key], dict | list):
                left.append(node[key])
    return found


def damage_tree(
    rng: random.Random, text: str, raw: Sequence[str] = RAW, read: Callable[[str], Any] = json.loads
) -> str:
    """Replace, remove, add, move or repeat a value anywhere in a tree, and write it as JSON."""
    tree = {"top": read(text)}
    spots = places(tree)
    (node, key), twice = rng.choice(spots), ""
    match rng.randrange(8):
        case 0:
            del node[key]
        case 1 if isinstance(node, dict):
            node[rng.choice(("extra", "__class__", "self", ""))] = "@raw@"
        case 1:
            node.insert(key, "@raw@")
        case 2 if isinstance(node, dict):
            node["@twice@"], twice = "@raw@", key
        case 3:
            other, there = rng.choice(spots)
            node[key] = json.loads(json.dumps(other[there]))
        case _:
            node[key] = "@raw@"
    written = json.dumps(tree.get("top"), indent=rng.choice((None, 1)))
    return written.replace('"@raw@"', rng.choice(raw)).replace('"@twice@"', json.dumps(twice))


def damage_json(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Damage a tree; a file that has lost its form already is damaged as text."""
    try:
        return damage_tree(rng, data.decode()).encode("utf-8", "surrogatepass")
    except (ValueError, RecursionError):
        return damage_text(rng, data, other)


def zipped(members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """Return an archive of these members."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


_ZIP_FIELDS = {  # position and size within the local header, the directory's and its end
    b"PK\3\4": ((6, 2), (8, 2), (14, 4), (18, 4), (22, 4), (26, 2), (28, 2)),
    b"PK\1\2": ((8, 2), (10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (30, 2), (32, 2), (42, 4)),
    b"PK\5\6": ((8, 2), (10, 2), (12, 4), (16, 4), (20, 2)),
}


def damage_zip(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """Change a field of an archive's headers, or say that everything is encrypted."""
    headers = [(hit.start(), hit[0]) for hit in re.finditer(b"PK(?:\3\4|\1\2|\5\6)", data)]
    if not headers:
        return damage_bytes(rng, data, other)
    if rng.random() < 0.1:
        changed = bytearray(data + bytes(8))
        for start, signature in headers:
            changed[start + _ZIP_FIELDS[signature][0][0]] |= signature != b"PK\5\6"
        return bytes(changed[:-8])
    start, signature = rng.choice(headers)
    at, size = rng.choice(_ZIP_FIELDS[signature])
    return poke(rng, data, start + at, size)


def damage_members(change: Damage) -> Damage:
    """Return a damage that changes one member of an archive and writes it anew, checksums right."""

    def damage(rng: random.Random, data: bytes, other: bytes) -> bytes:
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                if not 0 < sum(member.file_size for member in archive.infolist()) < 10**7:
                    return damage_zip(rng, data, other)
                members = {name: archive.read(name) for name in archive.namelist()}
        except Exception:  # damaged before
            return damage_bytes(rng, data, other)
        name, another = rng.choice(list(members)), rng.choice(list(members.values()))
        match rng.randrange(12):
            case 0:
                del members[name]
            case 1:
                members[rng.choice(("extra.npy", "../" + name, name + "/"))] = members.pop(name)
            case 2:
                members[name] = another
            case _:
                members[name] = change(rng, members[name], another)
        return zipped(members, rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))

    return damage
