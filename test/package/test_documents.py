"""Documents: links that lead somewhere in a checkout, and a site, built strictly, that loads nothing from elsewhere."""

import importlib
import os
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest
import yaml
from python_process import run_python

_LINK = re.compile(r"(?<=\]\()(?P<path>[^)#\s:]*)(?:#(?P<anchor>[^)\s]*))?(?=\))")
_FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
_LOADING = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src", "use": "href"}
"""Elements that a browser fetches by itself, and the attribute that says from where."""


def documents(repository: Path) -> Iterator[Path]:
    yield from sorted(repository.glob("*.md"))
    yield from sorted((repository / "docs").glob("*.md"))
    yield from sorted((repository / "benchmarks" / "results").glob("*.md"))


def anchors(page: Path) -> set[str]:
    """Of the headings, as GitHub and MkDocs make them."""
    headings = re.findall(r"^#+ (.*)$", _FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    words = (re.sub(r"[^\w\s-]", "", heading.lower()).strip() for heading in headings)
    return {re.sub(r"\s", "-", one) for one in words}


def test_links_lead_somewhere_in_a_checkout_and_every_page_is_in_the_navigation(repository: Path) -> None:
    broken = []
    for page in documents(repository):
        for match in _LINK.finditer(_FENCE.sub("", page.read_text(encoding="utf-8"))):
            target = (page.parent / match["path"]).resolve() if match["path"] else page
            if not target.exists():
                broken.append(f"{page.name}: {match[0]}")
            elif match["anchor"] and target.suffix == ".md" and match["anchor"] not in anchors(target):
                broken.append(f"{page.name}: {match[0]}: no such heading")
    assert not broken
    text = (repository / "mkdocs.yml").read_text(encoding="utf-8")

    named = re.findall(r"[\w./-]+\.md", text.partition("\nnav:")[2])
    assert {one for one in named if "/" not in one} == {page.name for page in (repository / "docs").glob("*.md")}
    assert len(set(named)) == len(named)


def test_figures_and_layers_are_what_was_measured(repository: Path, monkeypatch) -> None:
    """Blocks between markers equal what docs_build/blocks.py makes of results and layers."""
    monkeypatch.syspath_prepend(repository / "docs_build")
    blocks = importlib.import_module("blocks")
    texts = {page: page.read_text(encoding="utf-8") for page in blocks.documents()}
    stale = [page.name for page, text in texts.items() if blocks.renewed(text) != text]
    assert not stale, f"run python docs_build/blocks.py: {stale}"
    used = {name for text in texts.values() for name in re.findall(r"docs_build/blocks\.py: (\w+)", text)}
    assert used == set(blocks.BLOCKS)


def test_the_workflow_pins_what_it_runs_and_may_only_read(repository: Path) -> None:
    text = (repository / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    workflow = yaml.safe_load(text)
    assert workflow["permissions"] == {"contents": "read"}
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    used = [step["uses"] for step in steps if "uses" in step]
    assert used
    assert all(re.fullmatch(r"actions/[a-z-]+@[0-9a-f]{40}", one) for one in used), used
    assert any("make test" in step.get("run", "") for step in steps)
    # Both releases of OpenCV that pip may take are tested.
    assert workflow["jobs"]["test"]["strategy"]["matrix"]["opencv"] == ["4", "5"]
    assert any("opencv-python-headless==${{ matrix.opencv }}.*" in step.get("run", "") for step in steps)


@pytest.fixture(scope="module")
def site(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site; strict: what MkDocs warns of is an error."""
    pytest.importorskip("mkdocs", reason="mkdocs is missing: install the extra 'docs'")
    pytest.importorskip("material", reason="mkdocs-material is missing: install the extra 'docs'")
    pytest.importorskip("mkdocstrings_handlers.python", reason="mkdocstrings is missing: install the extra 'docs'")
    folder = tmp_path_factory.mktemp("site")
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    run_python("-m", "mkdocs", "build", "--strict", "--site-dir", folder, cwd=repository, env=environment)
    return folder


class Loads(HTMLParser):
    """Addresses that a page loads without being asked, and those that it links to."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.linked: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        address = values.get(_LOADING.get(tag, ""))
        if address and not (tag == "link" and values.get("rel") in ("canonical", "next", "prev")):
            self.loaded.append(address)
        if tag == "a" and values.get("href"):
            self.linked.append(str(values["href"]))


def test_the_site_loads_nothing_from_elsewhere_and_links_to_files_that_are_there(site: Path) -> None:
    """Links out of docs/, to benchmarks and sources, are turned to what the site carries of them."""
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        found = Loads()
        found.feed(page.read_text(encoding="utf-8"))
        assert found.loaded
        assert not [one for one in found.loaded if re.match(r"(\w+:)?//", one)], page.name
        if page.name == "404.html":  # addressed from the root, wherever it is shown
            continue
        for address in (one for one in (*found.loaded, *found.linked) if not re.match(r"\w+:|//|#", one)):
            target = page.parent / address.partition("#")[0].partition("?")[0]
            assert target.exists(), f"{page.relative_to(site)}: {address}"
    assert (site / "repository/benchmarks/results/tracking.html").is_file()
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\(\s*[\"']?(https?:)?//", sheet.read_text(encoding="utf-8")), sheet.name
