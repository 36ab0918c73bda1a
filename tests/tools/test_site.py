"""The site of `make docs`, read as files: every link leads somewhere, its search finds, every verb has its place.

Truth: the files of the site themselves, and the names in `selfcal.VERBS`.
"""

from __future__ import annotations

import re
import subprocess
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urldefrag

import pytest

import selfcal

from conftest import ROOT

SITE = ROOT / "build" / "docs" / "site"


@pytest.fixture(scope="module")
def site() -> Path:
    if find_spec("mkdocs") is None:
        pytest.skip("NO MKDOCS: make docs")
    subprocess.run(["make", "docs"], cwd=ROOT, check=True, capture_output=True)
    return SITE


def test_the_page_of_python_has_every_verb() -> None:
    text = (ROOT / "tools" / "docs" / "python.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^::: selfcal\.verbs\.(\w+)\.\1$", text, re.MULTILINE)) == set(selfcal.VERBS)


def test_no_link_is_dead(site: Path) -> None:
    names: dict[Path, set[str]] = {}
    dead = []
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8", errors="replace")
        for link in re.findall(r'(?:href|src)="([^"]+)"', text) if page.name != "404.html" else []:
            place, anchor = urldefrag(link)
            if re.match(r"[a-z]+:|//", link):
                continue
            target = (page.parent / unquote(place)).resolve() if place else page
            target = target / "index.html" if target.is_dir() else target
            if target.suffix == ".html" and target.exists() and target not in names:
                names[target] = set(re.findall(r'\b(?:id|name)="([^"]+)"', target.read_text(encoding="utf-8")))
            if not target.exists() or (anchor and target in names and unquote(anchor) not in names[target]):
                dead.append(f"{page.relative_to(site)}: {link}")
    assert not dead


def test_the_search_works_from_a_file(site: Path, browser: Any) -> None:
    """Beside it nothing is fetched from elsewhere."""
    view, asked = browser.new_page(viewport={"width": 1280, "height": 900}), []
    view.on("request", lambda request: asked.append(request.url))
    view.goto((site / "tools" / "index.html").as_uri())
    view.keyboard.press("/")
    view.keyboard.type("overbound")
    view.wait_for_selector(".md-search-result__item", timeout=20_000)
    assert "overbound" in view.inner_text(".md-search-result__list").lower()
    assert all(url.startswith(("file:", "data:", "about:")) for url in asked), asked
    view.close()
