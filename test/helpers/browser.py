"""A headless Chromium for tests, driven through its DevTools protocol; needs nothing but the websockets that viser has.

The browser has an empty profile and a software renderer, and it may not reach anything but this machine.
"""

from __future__ import annotations

import base64
import itertools
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
_OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--disable-extensions", "--disable-default-apps", "--disable-domain-reliability"),
    *("--no-proxy-server", "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE localhost , EXCLUDE 127.0.0.1"),
    "--disable-features=BackForwardCache",  # a page that was left would keep its connection for 40 s
    *("--remote-debugging-port=0", "--remote-allow-origins=*", "--force-device-scale-factor=1"),
)
_START = 20.0


def executable() -> str | None:
    """The path of a Chromium, None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One tab of a size in pixels."""

    def __init__(self, width: int, height: int) -> None:
        path = executable()
        assert path is not None
        self._folder = tempfile.TemporaryDirectory(prefix="sq_browser_", ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [path, *_OPTIONS, f"--window-size={width},{height}", f"--user-data-dir={self._folder.name}", "about:blank"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            env={**os.environ, "HOME": self._folder.name},
        )
        self.events: list[dict[str, Any]] = []
        self._numbers = itertools.count(1)
        try:
            self._socket = self._connect()
            for domain in ("Page", "Network", "Runtime"):
                self.call(f"{domain}.enable")
            self.call(
                "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
            )
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End it and all of its processes."""
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._folder.cleanup()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The result of a DevTools command; events that come meanwhile are kept in ``events``."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=30))
            if message.get("id") == number:
                assert "error" not in message, message["error"]
                return message["result"]
            if "method" in message:
                self.events.append(message)

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression in the page."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def until(self, condition: Callable[[], Any], seconds: float = 90.0) -> Any:
        """The first true value of a condition.

        A killed node's subscriptions stay until DDS takes it for lost, 20 s, and a node may start slowly beside others.
        """
        deadline = time.monotonic() + seconds
        while not (value := condition()):
            assert time.monotonic() < deadline, f"waited in vain; the page says: {self.text()[:2000]}"
            time.sleep(0.05)
        return value

    def text(self) -> str:
        """What is to be read on the page."""
        return str(self.evaluate("document.body ? document.body.innerText : ''"))

    def picture(self) -> np.ndarray:
        """A screenshot (height, width, 3), red green blue."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]

    def click(self, words: str) -> None:
        """Click the visible button or tab that reads ``words``."""
        box = self.until(
            lambda: self.evaluate(
                "(() => { const all = [...document.querySelectorAll('button, [role=tab], label')]"
                f".filter(one => one.innerText.trim() === {json.dumps(words)} && one.offsetParent !== null);"
                "if (!all.length) return null; const b = all[0].getBoundingClientRect();"
                "return [b.x + b.width / 2, b.y + b.height / 2]; })()"
            )
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=box[0], y=box[1], button="left", clickCount=1)

    def requested(self) -> list[str]:
        """Addresses that the page has asked for, data and blobs left out."""
        self.evaluate("0")
        names = ("Network.requestWillBeSent", "Network.webSocketCreated")
        found = [one["params"] for one in self.events if one["method"] in names]
        addresses = [one.get("url") or one["request"]["url"] for one in found]
        return [one for one in addresses if not one.startswith(("data:", "blob:", "about:"))]

    def _connect(self) -> Any:
        from websockets.sync.client import connect

        port_file = Path(self._folder.name) / "DevToolsActivePort"
        deadline = time.monotonic() + _START
        while not (port_file.is_file() and len(port_file.read_text().splitlines()) == 2):
            assert self._process.poll() is None, "the browser has ended"
            assert time.monotonic() < deadline, "the browser does not start"
            time.sleep(0.05)
        port = port_file.read_text().splitlines()[0]
        import urllib.request

        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10) as answer:
            tabs = json.load(answer)
        address = next(one["webSocketDebuggerUrl"] for one in tabs if one["type"] == "page")
        return connect(address, max_size=None, proxy=None)
