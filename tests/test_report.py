import importlib.util
import json
import re
import shutil
import time
from pathlib import Path

import pytest

from fgtutor.errors import ReportError
from fgtutor.evaluation.report import Findings, markdown, write_report
from fgtutor.evaluation.shards import Run
from fgtutor.evaluation.tasks import Result
from fgtutor.statistics import Share

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "readme_table.py"
ROWS = [{"seed": seed, "outcome": "reached", "length": 8.1} for seed in range(3)]


@pytest.fixture
def folder(tmp_path):
    results = (
        Result(rows=ROWS[:2], seconds=2.0, machine={"cores": 2}),
        Result(rows=ROWS[2:], seconds=1.5, machine={"cores": 64}),
    )
    write_report(
        tmp_path / "report",
        Run(results),
        Findings(
            table="| a |\n| --- |\n| 100 |",
            caption="Three trials a cell.",
            figures={"note.txt": lambda path: path.write_text("a figure")},
        ),
        title="Success",
        settings={"command": "evaluate matrix", "seed": 4},
        began=time.time() - 10,
    )
    return tmp_path / "report"


@pytest.mark.parametrize(
    ("successes", "trials", "text"),
    [
        # Wilson's interval for 15 of 20 is 0.5313 to 0.8881 (see test_metrics).
        (15, 20, "75 (53-89)"),
        (200, 200, "100 (98-100)"),
        (750, 1000, "75.0 (72.2-77.6)"),
        (9996, 10_000, "99.96 (99.90-99.98)"),
    ],
)
def test_a_share_has_the_digits_that_its_trials_bear(successes, trials, text):
    assert str(Share(successes=successes, trials=trials)) == text


def test_shares_count_outcomes():
    assert Share.of(word == "reached" for word in ("reached", "fell", "reached")) == Share(
        successes=2, trials=3
    )


def test_a_markdown_table():
    table = markdown(["terrain", "ours"], [["steps", 3], ["gaps", "-"]])
    assert table == "| terrain | ours |\n| --- | --- |\n| steps | 3 |\n| gaps | - |"


def test_a_report_keeps_every_trial_and_where_it_came_from(folder):
    assert json.loads((folder / "rows.json").read_text()) == ROWS
    assert len((folder / "rows.json").read_text().splitlines()) == len(ROWS) + 2
    run = json.loads((folder / "run.json").read_text())
    assert run["settings"]["seed"] == 4 and run["trials"] == 3 and run["tasks"] == 2
    assert run["machines"] == [{"cores": 2}, {"cores": 64}]
    assert run["task_seconds"] == 3.5 and 10 <= run["wall_seconds"] < 20
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", run["finished"])
    assert (folder / "figures" / "note.txt").read_text() == "a figure"
    assert (folder / "table.md").read_text() == (
        "# Success\n\n| a |\n| --- |\n| 100 |\n\nThree trials a cell. 3 trials in all.\n"
    )


@pytest.fixture
def readme(tmp_path):
    path = tmp_path / "README.md"
    path.write_text("before\n<!-- table matrix -->\nold\n<!-- end matrix -->\nafter\n")
    return path


@pytest.fixture
def other(tmp_path):
    path = tmp_path / "results.md"
    path.write_text("<!-- table mixed -->\nold\n<!-- end mixed -->\n")
    return path


@pytest.fixture
def fill(readme, other, monkeypatch):
    spec = importlib.util.spec_from_file_location("readme_table", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    monkeypatch.setattr(script, "PAGES", (readme, other))
    return lambda *arguments: script.main([str(argument) for argument in arguments])


def another(folder, *, table, caption="Three", **settings):
    """Return a copy of a report folder with another table and some other settings."""
    path = shutil.copytree(folder, folder.parent / f"report-{len(list(folder.parent.iterdir()))}")
    text = (path / "table.md").read_text()
    text = text.replace("| a |\n| --- |\n| 100 |", table).replace("Three", caption)
    (path / "table.md").write_text(text)
    run = json.loads((path / "run.json").read_text())
    run["settings"] |= settings
    (path / "run.json").write_text(json.dumps(run))
    return path


def test_the_script_writes_the_table_between_its_markers(fill, folder, readme):
    date = json.loads((folder / "run.json").read_text())["finished"][:10]
    for _ in range(2):  # the second time changes nothing
        fill("matrix", folder)
        assert readme.read_text() == (
            "before\n<!-- table matrix -->\n| a |\n| --- |\n| 100 |\n\nThree trials a cell.\n\n"
            f"*3 trials of `fgtutor evaluate matrix`, {date}.*\n<!-- end matrix -->\nafter\n"
        )


def test_without_folders_the_commands_of_the_table_are_run(fill, other, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    other.write_text(
        other.read_text()
        + "    fgtutor evaluate matrix --robot toy --trials 1 \\\n"
        + "        --policies steps --terrains flat --workers 1  # mixed\n"
        + "    fgtutor evaluate matrix --robot toy --trials 1 --terrains mixed  # toy-mixed\n"
    )
    fill("mixed")
    assert "1 trials of `fgtutor evaluate matrix`" in other.read_text()
    assert [path.name for path in (tmp_path / "runs" / "tables").iterdir()] == ["mixed-1"]
    with pytest.raises(ReportError, match="no page shows a command with `# matrix` after it"):
        fill("matrix")


def test_every_table_of_the_results_has_its_command():
    pages = [SCRIPT.parents[1] / page for page in ("README.md", "docs/results.md")]
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    tables = set(re.findall(r"<!-- table (\S+) -->", text))
    assert tables == set(re.findall(r"^ +\S.*  # ([a-z0-9]+-[a-z0-9]+)$", text, re.MULTILINE))


def test_the_table_goes_to_the_page_that_has_its_markers(fill, folder, readme, other):
    before = readme.read_text()
    fill("mixed", folder)
    assert "| 100 |" in other.read_text() and readme.read_text() == before
    readme.write_text(other.read_text())
    with pytest.raises(ReportError, match=r"table mixed.*found 2"):
        fill("mixed", folder)


def test_folders_of_other_policies_join_the_table(fill, folder, readme):
    head = "| terrain | {} |\n| --- | --- |\n"
    steps = another(folder, table=head.format("ours") + "| steps | 99 |", zoo={"steps": "ab"})
    right = another(folder, table=head.format("general") + "| steps | 8 |", policies=["general"])
    below = another(folder, table=head.format("ours") + "| gaps | 97 |", zoo={"gaps": "cd"})
    fill("matrix", steps, right)
    assert (
        "| terrain | ours | general |\n| --- | --- | --- |\n| steps | 99 | 8 |\n\n"
    ) in readme.read_text()
    assert "*6 trials of" in readme.read_text()
    fill("matrix", steps, below)
    assert head.format("ours") + "| steps | 99 |\n| gaps | 97 |\n\n" in readme.read_text()


def test_folders_of_other_settings_have_a_table_below(fill, folder, readme):
    paper = another(folder, table="| a |\n| --- |\n| 93 |", caption="Paper's, three", taus="paper")
    fill("matrix", folder, paper)
    assert (
        "| a |\n| --- |\n| 100 |\n\nThree trials a cell.\n\n"
        "| a |\n| --- |\n| 93 |\n\nPaper's, three trials a cell.\n\n*6 trials of"
    ) in readme.read_text()


@pytest.mark.parametrize(
    ("table", "settings", "words"),
    [
        ("| a |\n| --- |\n| 100 |", {"seed": 5}, "differ in seed"),
        ("| a |\n| --- |\n| 100 |", {"zoo": {"steps": "cd"}}, "differ in steps"),
        ("| b |\n| --- |\n| 7 |", {}, "neither"),
        ("| a |\n| --- |\n| 7 |", {"caption": "Four", "zoo": {"steps": "cd"}}, "differ in steps"),
        ("| a |\n| --- |\n| 7 |", {"caption": "Four", "command": "x"}, "differ in command"),
    ],
)
def test_folders_that_are_not_of_one_table_do_not_join(
    fill, folder, readme, table, settings, words
):
    before = readme.read_text()
    mine = another(folder, table="| a |\n| --- |\n| 100 |", zoo={"steps": "ab"})
    with pytest.raises(ReportError, match=words):
        fill("matrix", mine, another(folder, table=table, **settings))
    assert readme.read_text() == before


def test_the_script_refuses_what_is_not_finished_or_not_marked(fill, folder, readme):
    readme.write_text("no markers")
    with pytest.raises(ReportError, match="<!-- table matrix -->"):
        fill("matrix", folder)
    (folder / "table.md").unlink()
    with pytest.raises(ReportError, match="no finished report"):
        fill("matrix", folder)
    assert readme.read_text() == "no markers"
