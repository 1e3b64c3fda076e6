"""Hooks of MkDocs: links from docs/ to the rest of the repository work on the site as they do in a checkout.

A page may link to any file of the repository by its relative path, ``../benchmarks/results/tracking.md`` for instance.
MkDocs knows only what lies in docs/: every other file that some page links to becomes part of the site under
``repository/``, Markdown as a page, anything else as it is, and the links are turned to it.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
"""Named in the navigation."""

_LINK = re.compile(r"(?<=\]\()(?P<path>[^)#\s:]+)(?P<anchor>#[^)\s]*)?(?=\))")
"""Target of a Markdown link or picture that names no scheme."""
_FOLDER = "repository"


def on_files(files: Files, *, config: Any) -> Files:
    """Add the linked files, and those that these link to."""
    known = {Path(one.abs_src_path).resolve() for one in files if one.abs_src_path}
    pages = [path for path in sorted(known) if path.suffix == ".md"]
    pages += [ROOT / name for name in PAGES]
    waiting = [*pages]
    while waiting:
        page = waiting.pop()
        if page not in known:
            files.append(File.generated(config, _site_path(page), abs_src_path=str(page)))
            known.add(page)
        if page.suffix == ".md":
            targets = {_target(page, match["path"]) for match in _LINK.finditer(page.read_text(encoding="utf-8"))}
            waiting += sorted(target for target in targets if target is not None and target not in known)
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Files) -> str:
    """Turn the links of a page to where their targets lie on the site."""
    source = Path(page.file.abs_src_path).resolve()
    here = posixpath.dirname(page.file.src_uri)

    def turned(match: re.Match[str]) -> str:
        target = _target(source, match["path"])
        if target is None:
            return match[0]
        return posixpath.relpath(_site_path(target), here or ".") + (match["anchor"] or "")

    return _LINK.sub(turned, markdown)


def _target(page: Path, link: str) -> Path | None:
    """The file of the repository that a link means; None if it means none, which MkDocs then reports."""
    path = (page.parent / link).resolve()
    return path if path.is_file() and path.is_relative_to(ROOT) else None


def _site_path(path: Path) -> str:
    docs = ROOT / "docs"
    if path.is_relative_to(docs):
        return path.relative_to(docs).as_posix()
    return f"{_FOLDER}/{path.relative_to(ROOT).as_posix()}"
