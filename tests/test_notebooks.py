"""The notebooks: what their sources give, small, without a trace of the machine; and they run."""

import base64
import io
import re
from dataclasses import replace
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output
from PIL import Image

from fgtutor.course import notebooks
from fgtutor.course.notebooks import (
    NotebooksConfig,
    budget,
    find_drift,
    find_faults,
    read_source,
    slide_of,
)
from fgtutor.errors import ConfigError, NotebookError

COURSE = Path(__file__).parent.parent / "notebooks"
SOURCES = sorted((COURSE / "src").glob("*.py"))
BUILT = sorted(COURSE.glob("*.ipynb"))
LESSON = pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)

LESSON_TEXT = """\
# %% [markdown]
# # A lesson
# %%
import os
print("fast:", os.environ["FGTUTOR_FAST"])
os.listdir(os.curdir)
# %%
from tqdm import tqdm
for _ in tqdm(range(3)):
    pass
# %%
from IPython.display import display
words = {"image/png": {"alt": "noise in many colours", "width": 4}}
display({"image/png": PNG, "text/html": "<b>one</b>"}, metadata=words, raw=True)
widget = {"application/vnd.jupyter.widget-view+json": {"model_id": "1"}, "text/plain": "a slider"}
display(widget, raw=True)
from fgtutor.course.ask import ALONE
display(widget | {"text/plain": "a question"}, metadata=ALONE, raw=True)
"""


def png(width: int = 40) -> str:
    """Return a base64 PNG with more colours than a palette holds."""
    noise = np.random.default_rng(0).integers(0, 256, (30, width, 3), dtype=np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noise).save(buffer, format="PNG")
    return base64.b64encode(buffer.getvalue()).decode()


def write_lesson(folder: Path, text: str = LESSON_TEXT, name: str = "01_lesson") -> Path:
    source = folder / "src" / f"{name}.py"
    source.parent.mkdir(exist_ok=True)
    source.write_text(text.replace("PNG", repr(png())))
    return source


def notebook_with(*outputs) -> nbformat.NotebookNode:
    cell = new_code_cell("1 + 1", outputs=list(outputs), id="a-cell")
    return new_notebook(cells=[cell])


# The course ---------------------------------------------------------------------------------------


def test_the_course_is_built_from_its_sources():
    assert len(SOURCES) == 13
    assert find_drift(COURSE) == {}, "run `fgtutor notebooks`"


@pytest.mark.parametrize("path", BUILT, ids=lambda path: path.stem)
def test_a_built_notebook_is_small_and_shows_no_path_no_error_and_no_widget(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert find_faults(notebook) == []
    pictures = sum(
        "image/png" in o.get("data", {}) for c in notebook.cells for o in c.get("outputs", ())
    )
    assert pictures >= 4  # a picture after each idea: a page without a kernel must teach


@LESSON
def test_a_lesson_says_what_it_gives_and_asks_and_where_it_leads(source):
    cells = read_source(source).cells
    first, last, number = cells[0].source, cells[-1].source, source.stem[:2]
    assert first.startswith(f"# {number} · ")
    for part in ("You will be able to", "Time", "Needs", "If a part is slow"):
        assert f"**{part}**" in first
    assert "## What to try" in last
    if int(number) < 13:  # the last one looks beyond the course
        assert f"../exercises/ex{number}.ipynb" in last


@LESSON
def test_a_lesson_has_short_cells_and_links_that_lead_somewhere(source):
    cells = read_source(source).cells
    lengths = [len(cell.source.splitlines()) for cell in cells if cell.cell_type == "code"]
    assert np.median(lengths) <= 7 and max(lengths) <= 20
    names = {path.stem for path in SOURCES}
    text = "\n".join(cell.source for cell in cells if cell.cell_type == "markdown")
    for target in re.findall(r"\]\((\d\d_\w+)\.ipynb\)", text):
        assert target in names


@pytest.mark.slow
@LESSON
def test_a_lesson_runs_from_top_to_bottom_in_fast_mode(source):
    notebook = notebooks.build(source, fast=True)
    assert all(c.execution_count for c in notebook.cells if c.cell_type == "code")


# The builder --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_build_keeps_text_and_pictures_and_is_the_same_twice(tmp_path, monkeypatch):
    monkeypatch.delenv("FGTUTOR_FAST", raising=False)
    source = write_lesson(tmp_path)
    config = NotebooksConfig(folder=tmp_path)
    assert notebooks.run(config) == 0
    built = tmp_path / "01_lesson.ipynb"
    before = built.read_bytes()
    _, text, bar, shown = nbformat.read(built, as_version=4).cells
    assert [cell.id for cell in (text, bar, shown)] == [
        "01_lesson-01",
        "01_lesson-02",
        "01_lesson-03",
    ]
    assert text.outputs[0].text == "fast: 0\n"
    assert text.outputs[1].data == {"text/plain": "[]"}  # an empty folder of its own
    assert bar.outputs == []
    picture, question = shown.outputs  # the widgets have gone
    assert question.data == {"text/plain": "a question"} and question.metadata == {}
    assert picture.data.keys() == {"image/png"}
    assert picture.metadata == {"image/png": {"alt": "noise in many colours"}}
    assert find_drift(tmp_path) == {}
    assert notebooks.run(config) == 0 and built.read_bytes() == before
    assert source.exists()
    assert notebooks.run(replace(config, fast=True)) == 0
    assert find_drift(tmp_path) == {"01_lesson": "was executed in fast mode"}


@pytest.mark.slow
def test_a_lesson_that_fails_is_named_and_writes_nothing(tmp_path):
    write_lesson(tmp_path, "# %%\n1 / 0\n")
    with pytest.raises(NotebookError, match=r"01_lesson.py does not run(.|\n)*ZeroDivisionError"):
        notebooks.run(NotebooksConfig(folder=tmp_path))
    assert list(tmp_path.glob("*.ipynb")) == []


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        (" 33%|###  | 1/3 [00:00<00:00, 9.1it/s]\r100%|#####| 3/3 [00:00<00:00, 9.2it/s]\n", True),
        ("toy steps:  10%|# | 4/40 [00:03<00:31, 1.2it/s, r_v=0.41]\n", True),
        ("UserWarning: this is old\n", False),
    ],
)
def test_only_a_progress_bar_may_go_to_stderr(text, kept):
    output = new_output("stream", name="stderr", text=text)
    if kept:
        assert list(notebooks._kept([output], "here")) == []
    else:
        with pytest.raises(NotebookError, match="here writes to stderr: UserWarning"):
            list(notebooks._kept([output], "here"))


def shown(data: str, alt: str = "noise in many colours") -> nbformat.NotebookNode:
    return new_output("display_data", {"image/png": data}, metadata={"image/png": {"alt": alt}})


def colours_of(data: str) -> int:
    with Image.open(io.BytesIO(base64.b64decode(data))) as image:
        return len(np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0))


def test_pictures_keep_their_colours_while_there_is_room(monkeypatch):
    notebook = notebook_with(shown(png(400)), shown(png(40)))
    large, small = (output.data for output in notebook.cells[0].outputs)
    before = colours_of(large["image/png"]), small["image/png"]
    notebooks.slim(notebook)
    assert (colours_of(large["image/png"]), small["image/png"]) == before
    monkeypatch.setattr(notebooks, "LIMIT", len(nbformat.writes(notebook)) - 1)
    notebooks.slim(notebook)  # now the largest gives way, and that is enough
    assert 64 < colours_of(large["image/png"]) <= 256
    assert small["image/png"] == before[1]
    monkeypatch.setattr(notebooks, "LIMIT", 0)
    notebooks.slim(notebook)
    assert colours_of(large["image/png"]) <= 64


def test_a_picture_keeps_its_size():
    for colours in (None, 16):
        data = notebooks.recode(png(400), colours)
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            assert image.size == (400, 30)


@pytest.mark.parametrize(
    ("output", "fault"),
    [
        (
            new_output("stream", name="stdout", text="in /srv/data/run"),
            "absolute path /srv/data/run",
        ),
        (new_output("stream", name="stdout", text=r"in C:\Users\me"), r"absolute path C:\\U"),
        (new_output("display_data", {"text/html": "<b>x</b>"}), "holds text/html"),
        (new_output("error", ename="E", evalue="", traceback=[]), "holds an error"),
        (shown("A" * notebooks.LIMIT), "fewer or smaller"),
        (shown("A", alt="a figure"), "cell a-cell has a picture without alt text"),
        (new_output("display_data", {"image/png": "A"}), "without alt text"),
    ],
)
def test_what_a_notebook_must_not_hold_is_named(output, fault):
    (said,) = find_faults(notebook_with(output))
    assert re.search(fault, said)


@pytest.mark.parametrize(
    "text",
    [
        "1 / F_max",
        "../exercises/ex01.ipynb",
        "https://a.org/b/c",
        "headings 0/2/4/6",
        "m/s",
        "r_v/x/y",
    ],
)
def test_what_only_looks_like_a_path_may_stand(text):
    output = new_output("stream", name="stdout", text=text)
    assert find_faults(notebook_with(output)) == []


def test_widget_state_is_a_fault():
    notebook = new_notebook(metadata={"widgets": {}})
    assert find_faults(notebook) == ["widget state in the metadata"]


def test_drift_is_found_and_says_where(tmp_path):
    source = write_lesson(tmp_path)
    assert find_drift(tmp_path) == {"01_lesson": "was never built"}
    built = tmp_path / "01_lesson.ipynb"
    notebook = read_source(source)
    notebook.metadata["fgtutor"] = {"fast": False, "specialists": {}}
    nbformat.write(notebook, built)
    assert find_drift(tmp_path) == {}
    source.write_text(source.read_text().replace("range(3)", "range(4)"))
    assert find_drift(tmp_path) == {"01_lesson": "differs from its source from cell 2 on"}
    source.unlink()
    assert find_drift(tmp_path) == {"01_lesson": "has no source in src"}


def test_numbers_of_other_specialists_are_stale(tmp_path):
    source = write_lesson(tmp_path, '# %%\nrobot = "toy"\n')
    notebook = read_source(source)
    assert notebooks.specialists_of(notebook).keys() == {"toy"}
    notebook.metadata["fgtutor"] = {"specialists": {"toy": "of last week"}}
    nbformat.write(notebook, tmp_path / "01_lesson.ipynb")
    assert "other specialists" in find_drift(tmp_path)["01_lesson"]


def test_the_check_names_what_to_run_and_fails(tmp_path, capsys):
    write_lesson(tmp_path)
    assert notebooks.run(NotebooksConfig(folder=tmp_path, check=True)) == 1
    assert "01_lesson was never built: run `fgtutor notebooks" in capsys.readouterr().out


def test_an_unknown_lesson_is_named_with_those_there_are(tmp_path):
    write_lesson(tmp_path)
    with pytest.raises(ConfigError, match=r"no source for 99; there are 01_lesson"):
        notebooks.run(NotebooksConfig(folder=tmp_path, names=("99",)))


# The budget ---------------------------------------------------------------------------------------


def test_the_budget_says_which_one_is_in_force(monkeypatch, capsys):
    monkeypatch.delenv("FGTUTOR_FAST", raising=False)
    assert budget(fast=5, full=600, unit="rounds", each=0.5) == 600
    said = capsys.readouterr().out
    assert said.startswith(
        "in full: 600 rounds, about 5 min on two CPU cores; with FGTUTOR_FAST=1: 5"
    )
    monkeypatch.setenv("FGTUTOR_FAST", "1")
    assert budget(fast=5, full=600) == 5
    assert capsys.readouterr().out == "fast: 5 rounds; without FGTUTOR_FAST=1: 600 rounds\n"


def test_a_heading_begins_a_slide_and_a_picture_one_below():
    assert slide_of(new_markdown_cell("## Title"))["slideshow"] == {"slide_type": "slide"}
    assert slide_of(new_markdown_cell("text")) == slide_of(new_code_cell("1")) == {}
    drawn = new_code_cell("draw()", outputs=[shown("AAAA")])
    assert slide_of(drawn)["slideshow"] == {"slide_type": "subslide"}
    for built in BUILT:
        for cell in nbformat.read(built, 4).cells:
            assert cell.metadata == slide_of(cell), f"{built.name}: {cell.source:.60}"
