"""A headless Chromium that opens a page, for tests: what it shows as text and as a picture.

The profile is empty, the renderer is software, and no name is resolved.
"""

import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
_OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--disable-extensions", "--no-proxy-server", "--host-resolver-rules=MAP * ~NOTFOUND", "--hide-scrollbars"),
    *("--force-device-scale-factor=1", "--virtual-time-budget=5000"),
)


def executable() -> str | None:
    return next((path for name in NAMES if (path := shutil.which(name))), None)


def opened(page: Path, folder: Path, script: str = "", size: tuple[int, int] = (640, 480)) -> tuple[str, np.ndarray]:
    """Text and picture (height, width, 3), red green blue, of a page after a ``script`` has run in it."""
    path = executable()
    assert path is not None
    copy, picture = folder / "opened.html", folder / "opened.png"
    copy.write_text(page.read_text().replace("</body>", f"<script>{script}</script></body>"))
    command = [path, *_OPTIONS, f"--user-data-dir={folder / 'profile'}", f"--window-size={size[0]},{size[1]}"]
    run = subprocess.run(
        [*command, "--dump-dom", f"--screenshot={picture}", copy.as_uri()], capture_output=True, text=True, timeout=120
    )
    shown = cv2.imread(str(picture))
    assert shown is not None, run.stderr
    text = _Text()
    text.feed(run.stdout)
    return re.sub(r"\s+", " ", " ".join(text.words)), shown[..., ::-1]


class _Text(HTMLParser):
    """The words of a document outside of scripts and styles."""

    def __init__(self) -> None:
        super().__init__()
        self.words: list[str] = []
        self._hidden = False

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self._hidden = tag in ("script", "style")

    def handle_endtag(self, tag: str) -> None:
        self._hidden = False

    def handle_data(self, data: str) -> None:
        if not self._hidden:
            self.words.append(data)
