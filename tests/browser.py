"""A headless Chromium, driven over its DevTools pipe: two file descriptors and JSON, so no package is needed."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

_NAMES = ("chromium", "chromium-browser", "google-chrome-stable", "google-chrome", "chrome")
# WebGL without a graphics card, and nothing that asks the network by itself.
_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu-sandbox",
    "--disable-dev-shm-usage",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-extensions",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)
_PATIENCE = 60.0  # seconds until an answer is missed


def find_browser() -> str | None:
    """The path of a Chromium or Chrome on this machine; None where there is none."""
    return next((path for name in _NAMES if (path := shutil.which(name))), None)


class Browser:
    """A page in a browser.

    Attributes:
        requests: The addresses that were asked for.
        complaints: Errors on the console, and exceptions.
    """

    def __init__(self, asked: int, answers: int) -> None:
        self.requests: list[str] = []
        self.complaints: list[str] = []
        self._asked, self._answers, self._rest, self._number, self._session = asked, answers, b"", 0, ""

    def call(self, method: str, **arguments: Any) -> dict[str, Any]:
        """The answer of a DevTools method."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": arguments}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._asked, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def open(self, width: int, height: int, dark: bool = False) -> None:
        """Opens a page of a size in CSS pixels."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def visit(self, path: Path, until: str) -> None:
        """Loads a file and waits until an expression is true there."""
        answer = self.call("Page.navigate", url=path.resolve().as_uri())
        assert "errorText" not in answer, answer
        end = time.monotonic() + _PATIENCE
        while not self.value(until):
            assert time.monotonic() < end, (until, self.complaints)
            time.sleep(0.05)

    def value(self, expression: str) -> Any:
        """The value of a JavaScript expression, of a promise what it comes to."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def frame(self) -> None:
        """Waits until what was changed is drawn."""
        self.value("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def click(self, x: float, y: float) -> None:
        """Clicks at a place in CSS pixels."""
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def key(self, key: str) -> None:
        """Presses a key."""
        text = {"text": "\r"} if key == "Enter" else {"text": key} if len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def picture(self, whole: bool = False) -> np.ndarray:
        """The pixels (height, width, 3) of what is seen, or of the whole page."""
        self.frame()
        shot = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        with Image.open(io.BytesIO(base64.b64decode(shot["data"]))) as image:
            return np.asarray(image.convert("RGB"))

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            assert select.select([self._answers], [], [], _PATIENCE)[0], "the browser does not answer"
            more = os.read(self._answers, 1 << 20)
            assert more, "the browser ended"
            self._rest += more
        first, _, self._rest = self._rest.partition(b"\0")
        message = json.loads(first)
        self._listen(message.get("method", ""), message.get("params", {}))
        return message

    def _listen(self, method: str, told: dict[str, Any]) -> None:
        if method == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(told["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and told["type"] in ("error", "assert"):
            self.complaints.append(json.dumps(told["args"]))
        elif method == "Log.entryAdded" and told["entry"]["level"] == "error":
            self.complaints.append(told["entry"]["text"])


@contextlib.contextmanager
def browser(folder: Path, width: int = 1280, height: int = 900, dark: bool = False) -> Iterator[Browser]:
    """A page in a browser that keeps its files in a folder, until it is left."""
    path = find_browser()
    assert path is not None
    asked_there, asked = os.pipe()
    answers, answers_there = os.pipe()
    # Chromium looks for them at 3 and 4. First out of the way: one may already have the other's number.
    place = (
        f"import os, sys; from fcntl import F_DUPFD, fcntl; a, b = fcntl({asked_there}, F_DUPFD, 10), "
        f"fcntl({answers_there}, F_DUPFD, 10); os.dup2(a, 3); os.dup2(b, 4); os.execv(sys.argv[1], sys.argv[1:])"
    )
    start = [sys.executable, "-ISc", place]
    command = [*start, path, *_FLAGS, f"--user-data-dir={folder / 'profile'}", "about:blank"]
    environment = os.environ | {"HOME": str(folder), "XDG_CONFIG_HOME": str(folder), "XDG_CACHE_HOME": str(folder)}
    process = subprocess.Popen(
        command,
        pass_fds=(asked_there, answers_there),
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(asked_there)
    os.close(answers_there)
    try:
        page = Browser(asked, answers)
        page.open(width, height, dark)
        yield page
        page._session = ""
        page.call("Browser.close")
    finally:
        process.terminate()
        process.wait(20)
        os.close(asked)
        os.close(answers)
