"""The pages that people read first: links lead somewhere, commands are understood, code runs."""

import importlib
import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from fgtutor import __main__ as cli

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
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
    links = re.findall(r"\]\((?!https://arxiv\.org/abs/)([^)#]+)(?:#[^)]*)?\)", page.read_text())
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


def test_make_targets_and_extras_that_pages_name_exist():
    text = "\n".join(path.read_text() for path in PAGES)
    targets = set(re.findall(r"^ {4}make ([a-z-]+)", text, re.MULTILINE))
    assert {"demo", "test", "lab"} <= targets
    rules = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert targets <= set(rules)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = [name.split(",") for name in re.findall(r"pip install .*\.\[([a-z,]+)\]", text)]
    assert named and set().union(*named) <= extras["optional-dependencies"].keys()


@pytest.mark.slow
def test_the_readmes_line_starts_jupyterlab_for_root_too(tmp_path):
    (line,) = re.findall(r"^ {4}\.venv/bin/(jupyter lab [^#\n]*)", README, re.MULTILINE)
    program = [sys.executable, "-m", *line.split(), "--no-browser", "--ServerApp.port=0"]
    folders = {f"JUPYTER_{kind}_DIR": str(tmp_path) for kind in ("CONFIG", "DATA", "RUNTIME")}
    with subprocess.Popen(
        program, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=os.environ | folders
    ) as server:
        assert server.stderr is not None
        said = []
        for words in server.stderr:
            said.append(words)
            if "http://127.0.0.1:" in words:
                break
        server.terminate()
    assert "http://127.0.0.1:" in said[-1], "".join(said)


@pytest.mark.slow
def test_the_example_in_the_readme_drives_to_its_goal(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(example, {})
    route, *_, episode = capsys.readouterr().out.splitlines()
    assert route.startswith("Route(") and episode.startswith("Episode(reached")
