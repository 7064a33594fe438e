"""The lock file: all that fgtutor brings is pinned, to what each Python named there can install."""

import re
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

LOCK = Path(__file__).parents[1] / "constraints.txt"
OF_A_BUILD = re.compile("nvidia|cuda|triton")
"""What a build of torch for a GPU pins by itself."""


@pytest.fixture(scope="module")
def pins() -> dict[str, str]:
    lines = [line for line in LOCK.read_text().splitlines() if not line.startswith("#")]
    return {canonicalize_name(name): pin for name, pin in (line.split("==") for line in lines)}


def test_everything_that_fgtutor_brings_is_pinned(pins):
    brought, ahead = set(), [("fgtutor", frozenset({"lab", "dev", "cluster", "site"}))]
    while ahead:
        name, extras = ahead.pop()
        if (name, extras) in brought:
            continue
        try:
            requirements = [Requirement(line) for line in distribution(name).requires or ()]
        except PackageNotFoundError:
            continue  # of the extra that only some install, or of another platform
        brought.add((name, extras))
        ahead += [
            (canonicalize_name(requirement.name), frozenset(requirement.extras))
            for requirement in requirements
            if requirement.marker is None
            or any(requirement.marker.evaluate({"extra": extra}) for extra in extras | {""})
        ]
    names = {name for name, _ in brought} - {"fgtutor"}
    assert len(names) > 50
    assert not {name for name in names if not OF_A_BUILD.match(name)} - pins.keys()


def test_every_pin_installs_on_the_first_release_of_each_python(pins):
    ours = SpecifierSet(distribution("fgtutor").metadata["Requires-Python"])
    pythons = [first for first in (f"3.{minor}.0" for minor in range(50)) if first in ours]
    assert pythons[0] == "3.11.0" and len(pythons) < 50, "which has an upper end"
    refused = {}
    for name in pins:
        try:
            wanted = distribution(name).metadata.get("Requires-Python")
        except PackageNotFoundError:
            continue
        if not all(first in SpecifierSet(wanted or "") for first in pythons):
            refused[name] = wanted
    assert not refused
