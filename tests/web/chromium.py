"""A headless Chromium, driven over its DevTools protocol; tests skip where there is none."""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import signal
import subprocess
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from waiting import until

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def found() -> str | None:
    """Path of a browser, None where there is none."""
    return next((path for name in NAMES if (path := shutil.which(name)) is not None), None)


class Chromium:
    """A browser of its own, with a profile in ``folder``."""

    def __init__(self, folder: Path) -> None:
        path = found()
        profile = folder / "profile"
        self._process = subprocess.Popen(
            [
                path,
                "--headless=new",
                "--no-sandbox",  # as root, and in containers
                "--disable-gpu",
                "--disable-dev-shm-usage",
                "--no-first-run",
                "--no-default-browser-check",
                "--disable-background-networking",
                "--disable-component-update",
                "--disable-extensions",
                "--remote-debugging-port=0",
                f"--user-data-dir={profile}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # its processes end together
        )
        told = profile / "DevToolsActivePort"
        until(lambda: told.exists() and told.read_text().count("\n") >= 1, "the DevTools port")
        self._port = int(told.read_text().split()[0])
        self.pid = self._process.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(10)

    def page(self) -> Tab:
        """A new tab."""
        request = urllib.request.Request(
            f"http://127.0.0.1:{self._port}/json/new?about:blank", method="PUT"
        )
        with urllib.request.urlopen(request, timeout=20) as answer:
            return Tab(json.load(answer)["webSocketDebuggerUrl"])


class Tab:
    """One tab.

    Attributes:
        log: texts of console messages and of refusals by the content policy.
    """

    def __init__(self, address: str) -> None:
        from websockets.sync.client import connect

        self._stack = ExitStack()
        self._socket = self._stack.enter_context(
            connect(address, max_size=64 * 2**20, compression=None, ping_interval=None)
        )
        self._numbers = itertools.count(1)
        self.log: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Performance"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=30))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        params = message.get("params", {})
        if message.get("method") == "Log.entryAdded":
            self.log.append(params["entry"]["text"])
        elif message.get("method") == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.log.append(str(details.get("exception", {}).get("description", details["text"])))
        elif message.get("method") == "Runtime.consoleAPICalled":
            self.log.append(" ".join(str(arg.get("value")) for arg in params["args"]))

    def size(self, width: int, height: int, *, scale: float = 1.0, phone: bool = False) -> None:
        """Take a screen's size."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=scale,
            mobile=phone,
        )

    def go(self, url: str) -> None:
        """Go to a page."""
        result = self.call("Page.navigate", url=url)
        assert "errorText" not in result, result

    def value(self, expression: str) -> Any:
        """Value of an expression in the page."""
        result = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait(self, expression: str, timeout_s: float = 30.0) -> Any:
        """Wait until an expression holds; its value."""
        return until(lambda: self.value(expression), expression, timeout_s)

    def picture(self, path: Path, *, whole: bool = False) -> None:
        """Take a screenshot."""
        result = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(result["data"]))

    def metrics(self) -> dict[str, float]:
        """Chromium's counts of the page: heap, nodes, listeners, times."""
        found_ = self.call("Performance.getMetrics")["metrics"]
        return {metric["name"]: metric["value"] for metric in found_}

    def close(self) -> None:
        """End the connection; the tab ends with its browser."""
        self._stack.close()
