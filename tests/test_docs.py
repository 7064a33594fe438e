"""The pages that people read first: links lead somewhere, commands are understood, code runs."""

import importlib
import re
import shlex
from pathlib import Path

import pytest

from fgtutor import __main__ as cli

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
LESSONS = sorted((ROOT / "notebooks" / "src").glob("*.py"))


def commands(path: Path) -> list[str]:
    """Return the commands of a page, or of a notebook's prose, that stand in code with options."""
    text = path.read_text()
    if path in LESSONS:
        text = re.sub(r"^# ?", "", text, flags=re.MULTILINE)
    text = text.replace("\\\n", " ")
    lines = re.findall(r"^ {4}(?:\S*/|torchrun .*-m )?(fgtutor .*)$", text, re.MULTILINE)
    return [*lines, *re.findall(r"`(fgtutor [^`]*--[^`]*)`", text)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text())
    assert not [link for link in links if not (page.parent / link).exists()]


COMMANDS = dict.fromkeys(line for path in [*PAGES, *LESSONS] for line in commands(path))


@pytest.mark.parametrize("line", COMMANDS)
def test_commands_are_understood(line, monkeypatch):
    names = [name for name in cli.COMMANDS if line.startswith(f"fgtutor {name}")]
    assert names
    module = importlib.import_module(f"fgtutor.{cli.COMMANDS[names[0]][0]}")
    asked = []
    monkeypatch.setattr(module, "run", asked.append)
    assert cli.main(shlex.split(line, comments=True)[1:]) == 0 and len(asked) == 1


def test_every_page_with_commands_was_read():
    silent = {path.name for path in [*PAGES, *LESSONS] if not commands(path)}
    assert not silent & {"README.md", "a1.md", "cluster.md", "instructor.md", "13_scale_out.py"}


@pytest.mark.slow
def test_the_example_in_the_readme_drives_to_its_goal(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    exec(example, {})
    route, *_, episode = capsys.readouterr().out.splitlines()
    assert route.startswith("Route(") and episode.startswith("Episode(reached")
