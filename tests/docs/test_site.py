"""The documentation site as it is built: every link leads somewhere, anchors too, and nothing comes from another host.

`SITE_FOLDER=site` names what `scripts/build_docs.sh` has written; without it these tests skip.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urljoin, urlsplit

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
WRITTEN = sorted(page for page in DOCS.rglob("*.md") if page.parent.name != "decisions")


class Page(HTMLParser):
    """Links, what else a browser would fetch, and anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = {key: value or "" for key, value in attributes}
        self.anchors |= {found[key] for key in ("id", "name") if key in found}
        if tag == "a" and "href" in found:
            self.links.append(found["href"])
        if "src" in found:
            self.fetched.append(found["src"])
        if tag == "link" and found.get("rel") in ("stylesheet", "icon", "preload", "preconnect", "modulepreload"):
            self.fetched.append(found["href"])


@pytest.fixture(scope="module")
def site() -> Path:
    """The folder that `scripts/build_docs.sh` wrote: minutes on a busy machine, so `.ci/run` builds it once."""
    if not (folder := os.environ.get("SITE_FOLDER")):
        pytest.skip("needs SITE_FOLDER, the folder that scripts/build_docs.sh has written")
    return Path(folder)


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[str, Page]:
    found = {str(path.relative_to(site)): path for path in site.rglob("*.html")}
    return {name: Page(path.read_text(encoding="utf-8")) for name, path in found.items()}


def targets(pages: dict[str, Page]) -> Iterator[tuple[str, str, str, str]]:
    """Page, link, file and anchor of every link within the site."""
    for name, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if not parts.scheme and name != "404.html":  # whose links are those of the host's root
                yield name, link, urljoin(name, unquote(parts.path)) if parts.path else name, unquote(parts.fragment)


def test_every_link_and_anchor_is_there(site: Path, pages: dict[str, Page]) -> None:
    broken = []
    for name, link, path, anchor in targets(pages):
        path = path or "index.html"
        path = path if path.endswith(("html", "png", "xml")) or "." in path else f"{path.rstrip('/')}/index.html"
        if not (site / path).exists() or (anchor and path in pages and anchor not in pages[path].anchors | {"__top"}):
            broken.append(f"{name}: {link}")
    assert not broken
    assert sum(1 for _ in targets(pages)) > 1000


def test_nothing_comes_from_another_host(site: Path, pages: dict[str, Page]) -> None:
    fetched = {(name, address) for name, page in pages.items() for address in page.fetched}
    assert not [pair for pair in fetched if urlsplit(pair[1]).netloc]
    styles = [path.read_text(encoding="utf-8") for path in site.rglob("*.css")]
    assert not [found for text in styles for found in re.findall(r"(?:@import|url\()\s*[\"']?https?:[^)\"']*", text)]


def test_every_room_and_command_has_its_place(site: Path, pages: dict[str, Page]) -> None:
    import typer

    import torchpose as tp
    from torchpose.cli.main import app

    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]  # a group
    assert set(commands) <= pages["commands.html"].anchors
    described = set().union(*(page.anchors for name, page in pages.items() if name.startswith("api/")))
    for name in tp.__all__:
        value = getattr(tp, name)
        place = f"{value.__module__}.{name}" if isinstance(value, type) else f"api/{value.__name__.split('.')[1]}.html"
        assert place in described or place in pages, name


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: str(page.relative_to(DOCS)))
def test_pages_say_what_they_are_for(page: Path) -> None:
    """A title, and a sentence below it, before any command or table."""
    title, blank, first = page.read_text(encoding="utf-8").splitlines()[:3]
    assert title.startswith("# ")
    assert not blank
    assert re.match(r"[A-Za-z`\[]", first), first
    assert not first.startswith(("```", "|", "    "))
