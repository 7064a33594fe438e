"""The exercises in the browser: every check in Pyodide, and a notebook in JupyterLite by Chromium.

Node runs `tests/web/lite.mjs` in the Python that the page loads. The browser may ask nobody but the
server of the test: a policy forbids the rest, and whatever it refuses is reported.
"""

import importlib
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import ClassVar

import pytest
from browser import Page, Quiet, run_node, serving

from fgtutor.course.checks import SOLUTIONS

WEB = Path(__file__).parents[1] / "web"
WINDOW = "1300,1500"
LIMIT = 45_000_000
"""Bytes that the part may have."""
POLICY = "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; report-uri /refused"
SESSION = "jupyterapp.shell.currentWidget?.sessionContext?.session"
OUTPUTS = "[...document.querySelectorAll('.jp-OutputArea-output')].map(e => e.textContent)"


class Strict(Quiet):
    """A server whose pages may load from it alone; what they ask of others is noted."""

    refused: ClassVar[list[str]] = []

    def end_headers(self) -> None:
        self.send_header("Content-Security-Policy", POLICY)
        super().end_headers()

    def do_POST(self) -> None:  # noqa: N802
        report = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.refused.append(report["csp-report"]["blocked-uri"])
        self.send_response(204)
        self.end_headers()


@pytest.fixture(scope="module")
def lite() -> Iterator[ModuleType]:
    """The module that writes the site's part, which is none of the package."""
    pytest.importorskip("myst_nb", reason="the extra site is not installed: make site does")
    sys.path.insert(0, str(WEB))
    try:
        module = importlib.import_module("lite.export")
        if module.missing():
            pytest.skip(f"not installed, make site does: {', '.join(module.missing())}")
        try:
            module.fetched()
        except SystemExit as fault:
            pytest.skip(str(fault))
        yield module
    finally:
        sys.path.remove(str(WEB))


def test_an_exercise_says_what_is_true_in_a_browser(lite):
    assert lite.names() == [f"ex{number:02}" for number in (1, 2, *range(4, 13))]
    for name in lite.names():
        content = json.loads((WEB.parent / f"exercises/{name}.ipynb").read_text(encoding="utf-8"))
        text = "\n".join(cell["source"] for cell in lite.adapted(content, name)["cells"]
                         if cell["cell_type"] == "markdown")  # fmt: skip
        assert "**In the browser.**" in text and "../notebooks" not in text
        assert "it loads torch" not in text and "download `mine.py`" in text
    with pytest.raises(ValueError, match="ex06 has no part"):
        lite.adapted({"cells": [], "metadata": {}}, "ex06")


def test_every_package_of_the_browsers_python_has_a_licence(lite):
    rows = importlib.import_module("book.pages").licence_rows(lite.MODULES, lite.fetched())
    told = [row for row in rows.splitlines() if row.endswith("exercises in the browser |")]
    assert len(told) == len(list(lite.fetched().glob("*.whl"))) and "|  |" not in "".join(told)
    assert "| ipython | 9.4.0 | BSD-3-Clause |" in rows and "| pyodide | 0.27.7 | MPL-2.0 |" in rows


@pytest.mark.slow
def test_every_solution_passes_in_the_browsers_python(lite, node, tmp_path, capsys, monkeypatch):
    lite.write_pyodide(tmp_path / "pyodide")
    for name in lite.names():
        content = json.loads((WEB.parent / f"exercises/{name}.ipynb").read_text(encoding="utf-8"))
        (tmp_path / f"{name}.ipynb").write_text(json.dumps(lite.adapted(content, name)))
    monkeypatch.setenv("EXERCISES", " ".join(lite.names()))
    run_node(node, "lite.mjs", capsys, SITE=tmp_path)


def write(page: Page, begins: str, source: str) -> None:
    """Replace the source of the cell that begins so, as typing would."""
    found = page.evaluate(
        "(() => { for (const cell of jupyterapp.shell.currentWidget.content.model.cells) {"
        f" if (cell.sharedModel.getSource().startsWith({json.dumps(begins)})) {{"
        f" cell.sharedModel.setSource({json.dumps(source)}); return true; }} }} return false; }})()"
    )
    assert found, begins


def ask(page: Page, code: str) -> str:
    """Run code in the notebook's kernel and return what it printed."""
    return page.evaluate(
        f"(async () => {{ const words = []; const future = {SESSION}.kernel.requestExecute("
        f"{{code: {json.dumps(code)}}}); future.onIOPub = (m) => "
        "words.push(m.content.text ?? m.content.evalue ?? ''); await future.done;"
        " return words.join(''); })()"
    )


@pytest.mark.slow
def test_an_exercise_is_solved_with_the_network_off(lite, page, tmp_path, capsys):
    lite.export(tmp_path / "site/lite")
    size = sum(path.stat().st_size for path in (tmp_path / "site").rglob("*") if path.is_file())
    assert size < LIMIT
    # The test has to reach the notebook's cells, which the page does not offer by itself.
    settings = tmp_path / "site/lite/jupyter-lite.json"
    told = json.loads(settings.read_text())
    told["jupyter-config-data"]["exposeAppInBrowser"] = True
    settings.write_text(json.dumps(told))
    Strict.refused.clear()
    with serving(tmp_path / "site", Strict) as (address, sent):
        began = time.monotonic()
        page.call("Page.navigate", url=f"{address}lite/lab/index.html?path=ex01.ipynb")
        page.wait(f"window.jupyterapp && {SESSION}?.kernel?.status === 'idle'", "the kernel")
        started = time.monotonic() - began
        solutions = json.loads(SOLUTIONS.read_text(encoding="utf-8"))
        write(page, "def cells_of", solutions["ex01.q1"].replace("np.floor", "np.round"))
        write(page, "def patch_points", solutions["ex01.q2"])
        page.evaluate("void jupyterapp.commands.execute('notebook:run-all-cells')")
        said = page.wait(
            f"{OUTPUTS}.at(-1)?.startsWith('The worked solution opens') && {OUTPUTS}", "verdicts"
        )
        page.evaluate("jupyterapp.shell.currentWidget.content.scrollToItem(3, 'center')")
        page.screenshot(tmp_path / "lite.png")
        assert "ex01.q1 which cell holds a point?: wrong" in said[0]
        assert "Looks like rounding to the nearest" in said[0]
        assert "passedKept in mine.py.\nThe course so far: 1 of 59 questions" in said[2]
        assert any("needs torch, which is not here" in words for words in said)
        kept = "from fgtutor.course.checks import kept; print(kept())"
        assert ask(page, kept) == "ex01.q2 patch_points\n"
        # The file is the browser's own: a page that is opened anew has it.
        file = "jupyterapp.serviceManager.contents.get('mine.py', {content: true})"
        assert "def patch_points" in page.evaluate(f"{file}.then(m => m.content)")
        assert [one for one in page.errors if "favicon.ico" not in one] == []
        assert Strict.refused == [], "nothing was asked of others"
        page.evaluate("fetch('https://elsewhere.example/').catch(() => 0)")
        page.wait("new Promise(done => setTimeout(() => done(true), 300))", "the report")
        assert Strict.refused, "the policy would have told"
    sizes = f"{size / 1e6:.1f} MB in all, {sum(sent.values()) / 1e6:.1f} MB sent for a page"
    with capsys.disabled():
        print(f"\n    {sizes}; {started:.1f} s to an idle kernel; screenshot in {tmp_path}")
