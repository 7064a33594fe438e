"""Settings and records from outside: what fits comes back, what does not is named."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import pytest

from fgtutor.errors import ConfigError, MapError
from fgtutor.io.validation import (
    Count,
    Name,
    Positive,
    Seed,
    Unbounded,
    Unique,
    Width,
    arguments,
    check_fields,
    parse_record,
    read_record,
)


@dataclass(frozen=True, kw_only=True)
class Settings:
    speed: Positive = 1.0
    robots: Count = 3
    hidden: tuple[Count, ...] = (1, 2)
    kind: Literal["a", "b"] = "a"
    seed: Seed | None = None
    patience: Unbounded = float("inf")
    note: Any = None
    name: Name = "steps"
    terrains: Annotated[tuple[str, ...], Unique] = ()
    levels: Annotated[tuple[tuple[float, float], ...], Unique] = ()
    cold: bool = False

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Record:
    settings: Settings
    more: list[Settings]
    command: tuple[float, float, float]
    extra: dict[str, Any]


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("speed", float("nan"), "finite"),
        ("speed", float("inf"), "finite"),
        ("speed", -1, "greater than 0, got -1"),
        ("speed", "1", "valid number"),
        ("robots", 0, "greater than or equal to 1"),
        ("robots", 1.5, "integer"),
        ("robots", True, "integer"),
        ("robots", 10**400, "less than"),
        ("hidden", (4, 0), "hidden: 1: "),
        ("kind", "c", "'a' or 'b'"),
        ("seed", -1, "greater than or equal to 0"),
        ("patience", float("nan"), "greater than 0"),
        ("name", "a|b", "letters, digits"),
        ("name", "\x1b[31m", "got '\\x1b[31m'"),
        ("name", "\u202etxt", "letters, digits"),
        ("name", "M\udcff", "name: "),
        ("name", "../steps", "letters, digits"),
        ("name", "..", "letters, digits"),
        ("name", "a ", "at its ends"),
        ("name", "", "letters, digits"),
        ("name", "a" * 101, "letters, digits"),
        ("terrains", ("a", "b", "a"), "only once, 'a' is there twice"),
        ("levels", ((0.0, 1), (0, 1.0)), "only once"),
        ("cold", 1, "valid boolean"),
    ],
)
def test_a_setting_that_cannot_work_is_named(field, value, says):
    with pytest.raises(ConfigError, match=f"^{field}: ") as caught:
        Settings(**{field: value})
    assert says in str(caught.value)


@pytest.mark.parametrize("name", ["steps", "Brücke 2", "a1-steps_v1.2+x", "_walker", "階段"])
def test_a_name_is_a_word_in_any_language(name):
    assert Settings(name=name).name == name


class Base:
    def __init__(self, size: int, *, seed: int = 0) -> None: ...


class Middle(Base):
    def __init__(self, *args: Any, wide: Width, cls: Any = None, **more: Any) -> None: ...


class Last(Middle):
    def __init__(self, *args: Any, scale: Positive, kind: Literal["a"], **more: Any) -> None: ...


def test_what_a_class_takes_is_read_as_its_signature_says():
    data = {"wide": 3, "scale": 2, "kind": "a"}
    built = parse_record(arguments(Last, Base), data, MapError, "m")
    assert vars(built) == {"wide": 3, "scale": 2.0, "kind": "a"}
    for wrong in ({"wide": 0}, {"scale": "2"}, {"kind": "b"}, {"cls": None}, {"seed": 1}):
        with pytest.raises(MapError, match=f"m: {next(iter(wrong))}: "):
            parse_record(arguments(Last, Base), data | wrong, MapError, "m")


def test_values_are_read_as_strictly_as_json():
    for data in (["1"], [True], [1.0], [float("nan")], [object()], [10**5000]):
        with pytest.raises(MapError, match="m"):
            parse_record(list[int], {"a": data}["a"], MapError, "m")  # type: ignore
    assert parse_record(list[float], [1, 2.5], MapError, "m") == [1.0, 2.5]  # type: ignore


def test_numbers_of_numpy_are_numbers():
    assert Settings(speed=np.float32(2), robots=np.int64(3), hidden=[4, 5]).robots == 3


GOOD = '{"settings": {"robots": 2}, "more": [{}], "command": [1, 2, 3.5], "extra": {"a": [1]}}'


def test_a_record_comes_back_as_its_dataclass(tmp_path):
    (tmp_path / "r.json").write_text(GOOD)
    record = read_record(Record, tmp_path / "r.json", MapError)
    assert record.settings.robots == 2 and record.command == (1.0, 2.0, 3.5)
    assert record.more == [Settings()] and record.extra == {"a": [1]}


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"robots": 2', '"robot": 2', "settings.robot: unexpected"),
        ("[{}]", '[{"x": 1}]', "more.0.x: unexpected"),
        ("3.5", "NaN", "command.2: should be a finite number"),
        ("3.5", "1e999", "command.2: should be a finite number"),
        ("3.5", '"3.5"', "command.2: "),
        ('"robots": 2', '"robots": 0', "settings.robots: "),
        ('"robots": 2', f'"robots": 1{"0" * 400}', "settings.robots: "),
        (', "extra": {"a": [1]}', "", "extra: field required"),
        ('{"a": [1]}', "[" * 5000, "invalid JSON"),
        (GOOD, "", "invalid JSON"),
        (GOOD, "\udcff".encode("utf-8", "surrogateescape").decode("latin-1"), "invalid JSON"),
    ],
)
def test_a_record_that_does_not_fit_is_refused_with_the_place(old, new, says):
    with pytest.raises(MapError, match=r"^r\.json: ") as caught:
        parse_record(Record, GOOD.replace(old, new), MapError, "r.json")
    assert says in str(caught.value)


def test_a_file_that_is_missing_or_too_large_is_refused(tmp_path, monkeypatch):
    with pytest.raises(MapError, match="cannot read"):
        read_record(Record, tmp_path / "none.json", MapError)
    monkeypatch.setattr("fgtutor.io.validation.LARGEST_RECORD", 10)
    (tmp_path / "r.json").write_text(GOOD)
    with pytest.raises(MapError, match="more than 10"):
        read_record(Record, tmp_path / "r.json", MapError)
