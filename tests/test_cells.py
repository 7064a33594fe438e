"""Cells run as Jupyter runs them: IPython's syntax is understood, and its shell does nothing."""

import pytest

from fgtutor.course.grading.cells import Cells, compiled

RIGHT = "def fuse(k):\n    return k + 1\n"


def run(*cells: str) -> dict:
    namespace: dict = {}
    notebook = Cells(namespace)
    for number, source in enumerate(cells):
        notebook.run(notebook.compiled(source, f"<cell {number}>"))
    if "_loop" in notebook.__dict__:
        notebook._loop.close()
    return namespace


@pytest.mark.parametrize(
    "cell",
    [
        RIGHT + "fuse?",
        RIGHT + "?fuse",
        RIGHT + "fuse??",
        RIGHT + "files = !ls\nassert list(files) == []",
        RIGHT + "!pip install numpy",
        RIGHT + "%matplotlib inline",
        RIGHT + "%load_ext autoreload\n%autoreload 2",
        RIGHT + "if True:\n    %matplotlib inline",
        RIGHT + "if True:\n    !ls",
        RIGHT + "for _ in range(2):\n    %timeit -n1 -r1 fuse(1)\nx = 3",
        RIGHT + "get_ipython().run_line_magic('matplotlib', 'inline')\nget_ipython().system('ls')",
        RIGHT + "where = %pwd",
        RIGHT + "x = %time fuse(3)\nassert x == 4",
        RIGHT + "%time y = fuse(3)\nassert y == 4",
        RIGHT + "import asyncio\nawait asyncio.sleep(0.001)",
        RIGHT + "async def slow():\n    return 4\nassert await slow() == 4",
        "%%time\n" + RIGHT,
        "%%capture out\n" + RIGHT,
        "%%time\n%matplotlib inline\n" + RIGHT,
        "    " + RIGHT.replace("\n", "\n    "),
        ">>> def fuse(k):\n...     return k + 1\n",
        "In [3]: def fuse(k):\n   ...:     return k + 1\n",
    ],
)
def test_a_right_answer_stays_right(cell):
    assert run(cell)["fuse"](3) == 4


def test_a_continued_line_that_begins_with_percent_is_a_remainder():
    source = "def turned(k, n):\n    return (k + n\n   % 8\n   )\n%matplotlib inline\n"
    assert run(source)["turned"](3, 10) == 5
    text = 's = """\n%matplotlib inline\n!ls\n"""\n%matplotlib inline'
    assert run(text)["s"] == "\n%matplotlib inline\n!ls\n"


def test_tasks_go_on_in_the_next_cell():
    first = "import asyncio\nasync def put():\n    return 7\ntask = asyncio.ensure_future(put())"
    assert run(first + "\nawait asyncio.sleep(0)", "got = await task")["got"] == 7


def test_annotations_of_the_future_hold_for_later_cells():
    cells = ("from __future__ import annotations", "def f(x: Nowhere) -> Nothing:\n    return x")
    assert run(*cells)["f"](1) == 1


@pytest.mark.parametrize("cell", ["def spl(success", "x = = 3", "%%time\nx = = 3", "a b c"])
def test_what_is_no_syntax_anywhere_is_a_syntax_error(cell):
    with pytest.raises(SyntaxError):
        run(cell)


def test_other_cell_magics_are_ignored():
    assert "x" not in run("%%bash\nx=1", "%%writefile x.py\nx = 1", "%%html\n<b>x</b>")


def test_plain_python_needs_no_ipython():
    assert compiled("x = 1", "cell").co_filename == "cell"
