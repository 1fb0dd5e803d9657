"""A headless Chromium, spoken to through two pipes in the DevTools protocol; no other package is needed."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-pipe",
)
#: Draws WebGL without a graphics card.
SOFTWARE_WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
NO_WEBGL = ("--disable-3d-apis",)
SECONDS = 60.0
#: Until what was changed is drawn.
NEXT_FRAME = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"


class Browser:
    """One page of one browser; ``events`` are what it said since it was opened.

    Parameters
    ----------
    folder : Path
        For its profile; must be writable.
    *flags : str
        Beyond those that every test needs.
    """

    def __init__(self, folder: Path, *flags: str) -> None:
        assert CHROMIUM, "no Chromium on this machine"
        self.events: list[dict[str, Any]] = []
        self._count = 0
        self._rest = b""
        theirs_in, self._write = os.pipe()
        self._read, theirs_out = os.pipe()
        shell = f'exec "$@" 3<&{theirs_in} 4>&{theirs_out}'
        self._process = subprocess.Popen(
            ["/bin/bash", "-c", shell, "browser", CHROMIUM, *FLAGS, *flags, f"--user-data-dir={folder}", "about:blank"],
            pass_fds=(theirs_in, theirs_out),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._session = self._attached()

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._write)
        os.close(self._read)

    def _attached(self) -> str:
        targets = self._call("Target.getTargets", {})["targetInfos"]
        target = next(one["targetId"] for one in targets if one["type"] == "page")
        return str(self._call("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"])

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Answer of the page to one command."""
        return self._call(method, parameters, {"sessionId": self._session})

    def _call(self, method: str, parameters: dict[str, Any], rest: dict[str, Any] | None = None) -> dict[str, Any]:
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters, **(rest or {})}
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._count:
            self.events.append(answer)
        assert "error" not in answer, f"{method}: {answer.get('error')}"
        return dict(answer["result"])

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            assert select.select([self._read], [], [], SECONDS)[0], f"the browser said nothing for {SECONDS:g} s"
            piece = os.read(self._read, 1 << 20)
            assert piece, "the browser ended"
            self._rest += piece
        message, self._rest = self._rest.split(b"\0", 1)
        return dict(json.loads(message))

    def open(self, page: Path, size: tuple[int, int] = (1200, 900), *, script: bool = True) -> None:
        """Load a file and wait until it is drawn."""
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        width, height = size
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.call("Emulation.setScriptExecutionDisabled", value=not script)
        self.call("Page.navigate", url=page.as_uri())
        while not self.said("Page.loadEventFired"):
            self.events.append(self._next())

    def said(self, method: str) -> list[dict[str, Any]]:
        """Parameters of all events of a kind."""
        return [event["params"] for event in self.events if event["method"] == method]

    def complaints(self, *allowed: str) -> list[str]:
        """All that a page did which a page of ours does not do; ``allowed`` is how addresses may begin."""
        addresses = [one["request"]["url"] for one in self.said("Network.requestWillBeSent")]
        entries = [one["entry"] for one in self.said("Log.entryAdded")]
        return [
            *(f"asked for {one[:60]}" for one in addresses if not one.startswith(allowed or ("file:", "data:"))),
            *(one["text"] for one in entries if one["level"] == "error"),
            *(f"threw {one['exceptionDetails']['text']}" for one in self.said("Runtime.exceptionThrown")),
            *(f"logged {one['args']}" for one in self.said("Runtime.consoleAPICalled")),
            *(f"asked a person {one['message']}" for one in self.said("Page.javascriptDialogOpening")),
        ]

    def run(self, expression: str) -> Any:
        """Value of a JavaScript expression in the page; a promise is waited for."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def choose(self, selector: str, file: Path) -> None:
        """Give a file to the field of a page, as a person does who picks it."""
        field = self.call("Runtime.evaluate", expression=f"document.querySelector({json.dumps(selector)})")["result"]
        self.call("DOM.setFileInputFiles", files=[str(file)], objectId=field["objectId"])

    def screenshot(self) -> bytes:
        """PNG of what is seen."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
