"""Is a built site whole? Every link leads somewhere, and nothing is loaded from elsewhere.

Reads a folder of HTML, CSS and JavaScript; gives a sentence for each fault.
"""

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADS = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src",
         "video": "src", "audio": "src", "embed": "src", "object": "data"}  # fmt: skip
"""Which attribute of which element a browser fetches by itself."""
REMOTE = re.compile(r"^(https?:)?//")
IN_CSS = re.compile(r"""(?:url\(\s*|@import\s+)["']?((?:https?:)?//[^"')\s]+)""")
IN_SCRIPT = re.compile(
    r"""(?:\bfrom\s*|\bimport\s*\(?\s*|\bfetch\s*\(\s*|\bimportScripts\s*\(\s*|"""
    r"""\bnew (?:Worker|WebSocket|EventSource|URL)\s*\(\s*|\.(?:src|href)\s*=\s*|"""
    r"""\bopen\s*\(\s*["'](?:GET|POST)["']\s*,\s*)["'`]((?:https?:|wss?:)?//[^"'`]+)"""
)
"""What a script loads by an address that stands in it."""
ANCHOR = re.compile(
    r"""\b(\w+)\s*=\s*document\.createElement\(["']a["']\)"""
    r"""(?=.{0,200}?\b\1\.href\s*=\s*["'`]([^"'`]+))""",
    re.DOTALL,
)
"""An address that a script gives to a link, which loads nothing before somebody follows it."""


class Page(HTMLParser):
    """The addresses of a page, and the names that others may point at."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.names: set[str] = set()
        self.pictures_without_words = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what an element points at, and its name."""
        found = dict(attrs)
        self.names |= {value for key in ("id", "name") if (value := found.get(key))}
        address = found.get(LOADS.get(tag, ""))
        if address is not None and found.get("rel") not in ("canonical", "license"):
            self.loads.append(address)
        elif tag == "a" and found.get("href"):
            self.links.append(found["href"] or "")
        if tag == "img" and "alt" not in found:
            self.pictures_without_words += 1


def faults(site: Path) -> list[str]:
    """Return what is wrong with a site, file by file."""
    known = {path: Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}
    found = []
    for path, page in sorted(known.items()):
        where = path.relative_to(site)
        found += [f"{where} loads {one}" for one in page.loads if REMOTE.match(one)]
        found += [f"{where} leads nowhere: {one}" for one in _dead(site, path, page, known)]
        if page.pictures_without_words:
            found.append(f"{where} has {page.pictures_without_words} pictures without alt text")
    for path in sorted(site.rglob("*")):
        pattern = {".css": IN_CSS, ".js": IN_SCRIPT, ".mjs": IN_SCRIPT, ".html": IN_SCRIPT}
        if path.suffix in pattern:
            text = path.read_text(encoding="utf-8")
            links = {address for _, address in ANCHOR.findall(text)}
            remote = [one for one in pattern[path.suffix].findall(text) if one not in links]
            found += [f"{path.relative_to(site)} loads {one}" for one in remote]
    return found


def _dead(site: Path, path: Path, page: Page, known: dict[Path, Page]) -> Iterator[str]:
    """Yield the addresses on a page that lead to no file, or to no place in it."""
    for address in [*page.links, *page.loads]:
        parts = urlsplit(address)
        if parts.scheme or parts.netloc:
            continue
        if parts.path.startswith("/"):
            yield f"{address}, which is not relative"
            continue
        there = (path.parent / unquote(parts.path)).resolve() if parts.path else path
        if there.is_dir():
            there = there / "index.html"
        if not there.is_file() or not there.is_relative_to(site.resolve()):
            yield address
        elif parts.fragment and there in known:
            yield from [] if unquote(parts.fragment) in known[there].names else [address]
