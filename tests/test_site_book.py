"""The book of the site: a small one is built, its links and loads are checked, and it is opened.

Two notebooks and an exercise stand for all: the same settings build them, and `make site` checks
the whole in the same way. The browser has no network: it reaches a server on loopback only.
"""

import html
import importlib
import itertools
import json
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from browser import Page, serving

ROOT = Path(__file__).parents[1]
WEB = ROOT / "web"
NOTEBOOKS = ["01_elevation_maps", "02_a_robot_that_falls"]


@pytest.fixture(scope="module")
def web() -> Iterator[SimpleNamespace]:
    """The modules that build the site, which are no part of the package."""
    pytest.importorskip("sphinx", reason="the extra site is not installed: make site does")
    pytest.importorskip("myst_nb", reason="the extra site is not installed: make site does")
    if not (WEB / "node_modules/mathjax").is_dir():
        pytest.skip("web/node_modules is not there: make site installs it")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(WEB))
        names = ("cells", "check", "frames", "pages", "stage")
        modules = {name: importlib.import_module(f"book.{name}") for name in names}
        yield SimpleNamespace(build=importlib.import_module("build"), **modules)


@pytest.fixture(scope="module")
def site(web, tmp_path_factory) -> Path:
    """A site with a small book; the sliders of notebook 02 have their pictures, few of them."""
    folder = tmp_path_factory.mktemp("site")
    real = web.frames.frames_of

    def only_the_second(notebook, out, cache):
        return real(notebook, out, cache) if "02" in out.name else {}

    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Sphinx's own, about what it will remove one day
        few = {"sigma": 2, "command": 2, "speed": 3}
        patch.setitem(web.frames.POSITIONS, "TrackingSlides", few)
        patch.setattr(web.frames, "frames_of", only_the_second)
        patch.setattr(web.pages, "API", {"Maps": ("elevation", "errors")})
        web.build.build_book(
            folder / "book",
            tmp_path_factory.mktemp("scratch"),
            notebooks=NOTEBOOKS,
            exercises=["ex01"],
            frame_cache=folder / "frames",
        )
    for name in ("planner", "a1", "lite/lab"):
        (folder / name).mkdir(parents=True)
        (folder / name / "index.html").write_text("<!doctype html><title>live</title>")
    return folder


def texts(site: Path, name: str) -> str:
    return (site / "book" / name).read_text(encoding="utf-8")


@pytest.mark.slow
def test_every_link_leads_somewhere_and_nothing_comes_from_elsewhere(web, site):
    found = web.check.faults(site)
    # A small book lacks most pages that the map of the course links to, and no others.
    others = [
        one for one in found if not one.startswith("book/index.html leads nowhere: notebooks/")
    ]
    assert others == [] and len(found) == 13 - len(NOTEBOOKS)


@pytest.mark.slow
def test_pages_have_what_the_notebooks_have(site):
    text = texts(site, "notebooks/01_elevation_maps.html")
    assert 'alt="Three sketches. A pose' in text, "pictures keep their words"
    assert 'href="../exercises/ex01.html"' in text and 'href="../docs/notation.html"' in text
    assert "<p>(0.7 / 0.5, 0.2 / 0.5)" in text, "what is folded is read as Markdown"
    assert "mathjax/tex-svg.js" in text
    exercise = texts(site, "exercises/ex01.html")
    assert "NotImplementedError" in exercise
    assert 'href="../../lite/lab/index.html?path=ex01.ipynb"' in exercise
    assert "never observed" in texts(site, "api/elevation.html")
    assert "elevation_maps" in texts(site, "searchindex.js")


@pytest.mark.slow
def test_licences_are_those_of_what_is_installed(site):
    text = html.unescape(texts(site, "licences.html"))
    for name in json.loads((WEB / "package.json").read_text())["dependencies"]:
        assert f"{name}</" in text.split("<table")[1].split("</table")[0]
    assert "Apache-2.0" in text and "BSD-3-Clause" in text and "<p>?</p>" not in text


def test_a_cell_is_run_with_what_it_needs_alone(web):
    cells = ["a = []\nb = 2", "broken = 1 / 0", "a.append(b)", "c = 5", "print(a)\nlen(a) + b"]
    assert web.cells.needed(cells, 4) == [0, 2, 4]
    assert web.cells.run(cells, 4) == 3


def test_a_control_is_thinned_and_keeps_where_it_stands(web):
    slider = web.frames.w.FloatSlider(value=0.85, min=0.0, max=2.0, step=0.05, description="speed")
    control, values = web.frames._control(slider, 5)
    assert len(values) == 5 and values[control.start] == 0.85
    assert values == sorted(values) and values[0] == 0 and values[-1] == 2


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[notation](../docs/notation.md#a)", "[notation](../docs/notation.md#a)"),
        ("[02_x.ipynb](02_x.ipynb)", "[](02_x.ipynb)"),
        ("[README](../README.md#results)", "[README](../about.md#results)"),
        ("[gone](../docs/gone.md)", "gone"),
        ("[paper](https://arxiv.org/abs/2602.07932)", "[paper](https://arxiv.org/abs/2602.07932)"),
        ("```\n[gone](gone.md)\n```", "```\n[gone](gone.md)\n```"),
    ],
)
def test_links_are_those_of_the_book(web, text, expected):
    pages = ["docs/notation", "notebooks/02_x", "about"]
    assert web.stage.links(text, "notebooks/01", pages) == expected


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.html", "<script src='https://elsewhere.example/x.js'></script>"),
        ("a.html", "<img src='//elsewhere.example/x.png' alt=''>"),
        ("a.html", "<a href='gone.html'>x</a>"),
        ("a.html", "<a href='#gone'>x</a>"),
        ("a.html", "<a href='/a.html'>x</a>"),
        ("a.html", "<img src='a.html'>"),
        ("a.css", "@import 'https://elsewhere.example/x.css';"),
        ("a.css", "p { background: url(https://elsewhere.example/x.png) }"),
        ("a.js", "import x from 'https://elsewhere.example/x.js';"),
        ("a.js", "await fetch(`https://elsewhere.example/x`);"),
        ("a.js", "s = document.createElement('link'); s.href = 'https://elsewhere.example/x.css'"),
    ],
)
def test_a_fault_is_found(web, tmp_path, name, text):
    link = "t=document.createElement('a'),t.href='https://elsewhere.example/words'"
    (tmp_path / "good.js").write_text(link)
    (tmp_path / "good.html").write_text("<a href='https://arxiv.org/abs/2602.07932'>words</a>")
    assert web.check.faults(tmp_path) == []
    (tmp_path / name).write_text(text)
    assert len(web.check.faults(tmp_path)) == 1


def test_what_needs_what_is_what_the_readme_says(web):
    before = web.pages.needs("01 to 07 build on each other; 08 is new. 09 needs 02, 03 and 08; 10 "
                             "needs 06 and 09; 11 needs 06 to 08; 12 needs 07 and 11; 13 needs 09 "
                             "and 11.")  # fmt: skip
    assert before["09"] == ["02", "03", "08"] and before["11"] == ["06", "07", "08"]
    assert web.pages.direct(before)["11"] == ["08"] and web.pages.direct(before)["12"] == ["11"]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (told,) = re.findall(r"^\*\*Which needs which:\*\* (.*?) \*\*If", readme, re.M | re.S)
    drawn: dict[str, list[str]] = {}
    start = (ROOT / "notebooks/00_start_here.md").read_text(encoding="utf-8")
    for line in start.splitlines():
        chain = re.sub(r"\[.*?\]", "", line) if "-->" in line else ""  # without the words
        for old, new in itertools.pairwise(re.findall(r"\d\d", chain)):
            drawn.setdefault(new, []).append(old)
    wanted = web.pages.direct(web.pages.needs(told))
    assert drawn == {name: before for name, before in wanted.items() if before}
    with pytest.raises(ValueError, match="nothing on 13"):
        web.pages.needs("01 to 07 build on each other. 09 needs 02; 10 needs 06; 11 needs 06; "
                        "12 needs 07.")  # fmt: skip


@pytest.fixture
def address(site) -> Iterator[str]:
    """Where the site is served, below a prefix."""
    with serving(site.parent) as (address, _):
        yield f"{address}{site.name}/book/"


def visit(page: Page, address: str) -> None:
    page.call("Page.navigate", url=address)
    page.wait(
        f"location.href.startsWith('{address}') && document.readyState === 'complete'", address
    )


@pytest.mark.slow
def test_pages_open_search_finds_and_a_slider_answers(page, address, tmp_path):
    visit(page, address + "index.html")
    assert page.evaluate("document.querySelectorAll('.course-map a').length") == 13
    visit(page, address + "search.html?q=bilinear")
    found = "[...document.querySelectorAll('#search-results a')].map(a => a.href).join(' ')"
    assert "01_elevation_maps" in page.wait(found, "the search")
    visit(page, address + "notebooks/02_a_robot_that_falls.html")
    page.wait("document.querySelectorAll('mjx-container svg').length > 5", "the formulas")
    slides = "document.querySelector('figure.slides')"
    page.wait(f"{slides}.querySelectorAll('input[type=range]').length === 3", "the sliders")
    page.evaluate(f"{slides}.scrollIntoView({{block: 'center'}})")
    page.wait(f"{slides}.querySelector('img').naturalWidth === 760", "the first picture")
    before, words = page.evaluate(
        f"[{slides}.querySelector('img').src, {slides}.querySelector('img').alt]"
    )
    assert "sigma 0.25 m/s" in words
    page.screenshot(tmp_path / "slides.png")
    page.evaluate(f"{slides}.querySelector('input').focus()")
    page.press("ArrowRight", 39)
    page.wait(f"{slides}.querySelector('img').src !== {json.dumps(before)}", "another picture")
    page.wait(f"{slides}.querySelector('img').complete", "it to load")
    parts = ("querySelector('img').alt", "querySelector('figcaption').textContent",
             "querySelector('input').ariaValueText")  # fmt: skip
    after = [page.evaluate(f"{slides}.{part}") for part in parts]
    assert after[0] == after[1] != words and f"sigma {float(after[2]):.2f} m/s" in after[0]
    loaded = page.evaluate(
        "performance.getEntriesByType('resource').map(e => new URL(e.name).host)"
    )
    assert set(loaded) == {page.evaluate("location.host")}
    assert page.errors == []
