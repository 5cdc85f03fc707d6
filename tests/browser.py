"""Headless Chromium for tests of pages: starts it, sends mouse events, takes screenshots, by the DevTools protocol.

Conventions. Places are (x, y) in pixels from the upper left corner of the window. WebGL is drawn in software.
"""

from __future__ import annotations

import base64
import io
import itertools
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image

PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""Path of the browser; None without one."""

SIZE = 1000, 700

FLAGS = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--disable-gpu", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--remote-debugging-port=0", "--hide-scrollbars", "--disable-background-networking"),
)


class Tab:
    """A page of the browser."""

    def __init__(self, address: str) -> None:
        from websockets.sync.client import connect

        self._socket = connect(address, max_size=None, open_timeout=60, ping_interval=None)
        self._numbers = itertools.count(1)
        self.errors: list[str] = []
        for domain in ("Page", "Runtime", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol, and return its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            if message.get("method") == "Runtime.exceptionThrown":
                self.errors.append(str(message["params"]["exceptionDetails"].get("exception", {}).get("description")))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]

    def post(self, method: str, **params: Any) -> None:
        """Call a method and wait for no answer; :meth:`send` passes over it."""
        self._socket.send(json.dumps({"id": next(self._numbers), "method": method, "params": params}))

    def show(self) -> None:
        """Bring the tab to the front: Chromium draws nothing in hidden ones."""
        self.send("Page.bringToFront")

    def open(self, address: str) -> None:
        """Go to an address."""
        self.send("Page.navigate", url=address)

    def run(self, script: str) -> Any:
        """Value of an expression of JavaScript; a promise is awaited."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait_for(self, script: str, seconds: float = 60) -> Any:
        """Value of an expression once it is true.

        Raises:
            AssertionError: it is not true in time.
        """
        end = time.monotonic() + seconds
        while not (value := self.run(script)):
            assert time.monotonic() < end, f"not true within {seconds} s: {script}"
            time.sleep(0.1)
        return value

    def mouse(self, kind: str, place: tuple[float, float], **more: Any) -> None:
        """Send a mouse event: mousePressed, mouseMoved, mouseReleased or mouseWheel."""
        x, y = place
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 10) -> None:
        """Press the left button, move, and release it."""
        held = {"button": "left", "buttons": 1, "clickCount": 1}
        self.mouse("mouseMoved", start)
        self.mouse("mousePressed", start, **held)
        for share in np.linspace(0, 1, steps + 1)[1:]:
            self.mouse("mouseMoved", tuple(np.add(start, share * np.subtract(end, start)).tolist()), **held)
        self.mouse("mouseReleased", end, button="left", clickCount=1)

    def click(self, place: tuple[float, float]) -> None:
        """Click the left button."""
        self.mouse("mouseMoved", place)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, place, button="left", clickCount=1)

    def find(self, text: str, selector: str = "*") -> tuple[float, float]:
        """Middle of the innermost element with exactly this text.

        Raises:
            AssertionError: none in time.
        """
        wanted = json.dumps(text)
        script = f"""(() => {{ const found = [...document.querySelectorAll({json.dumps(selector)})]
            .filter(e => e.textContent.trim() === {wanted} && e.getBoundingClientRect().width > 0);
            if (!found.length) return null; const e = found[found.length - 1]; e.scrollIntoView({{block: "center"}});
            const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; }})()"""
        return tuple(self.wait_for(script))

    def screenshot(self, path: Path | None = None) -> np.ndarray:
        """The window, uint8 (H, W, 3); written as a PNG as well."""
        data = base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"])
        if path is not None:
            path.write_bytes(data)
        return np.asarray(PIL.Image.open(io.BytesIO(data)).convert("RGB"))


class Browser:
    """A running browser."""

    def __init__(self, port: int) -> None:
        self.port = port

    def tab(self, address: str) -> Tab:
        """Open a page in a new tab."""
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(request, timeout=60) as answer:
            tab = Tab(json.load(answer)["webSocketDebuggerUrl"])
        width, height = SIZE
        tab.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        tab.open(address)
        return tab


@contextmanager
def start_browser() -> Iterator[Browser]:
    """Start the browser with a profile of its own; it ends with the block."""
    with tempfile.TemporaryDirectory(prefix="chromium-", ignore_cleanup_errors=True) as profile:
        command = [PROGRAM, *FLAGS, f"--user-data-dir={profile}", f"--window-size={SIZE[0]},{SIZE[1]}", "about:blank"]
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            yield Browser(_find_port(Path(profile) / "DevToolsActivePort"))
        finally:
            child.terminate()
            child.wait(timeout=60)


def _find_port(file: Path) -> int:
    end = time.monotonic() + 60
    while time.monotonic() < end:
        words = file.read_text().split() if file.exists() else []
        if words:
            return int(words[0])
        time.sleep(0.1)
    raise AssertionError("Chromium did not start within 60 s")
