"""Open a page in headless Chromium: what it draws, and what its console says. CHROMIUM may name the
program.

python -m tests.browser URL PICTURE.png [WIDTH [HEIGHT [light|dark [SECONDS]]]]
"""

import base64
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from websockets.sync.client import connect

_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--enable-unsafe-swiftshader",
    "--use-angle=swiftshader",
    "--remote-debugging-port=0",
    "--no-first-run",
    "--disable-extensions",
    "--mute-audio",
)
_START_S = 240.0


@dataclass(frozen=True)
class Visit:
    """What a page did.

    Attributes:
        picture: The page as PNG.
        errors: Errors of its console, and exceptions that nobody caught.
        requests: Addresses that it asked for.
        overflow: By how many pixels its content is wider than the window.
    """

    picture: bytes
    errors: Sequence[str]
    requests: Sequence[str]
    overflow: int


def visit(
    url: str, width: int = 1200, height: int = 800, scheme: str = "light", seconds: float = 3.0
) -> Visit:
    """Open a page, wait, and look.

    Args:
        url: Its address.
        width: Of the window [pixels].
        height: Of the window [pixels].
        scheme: What the reader prefers, "light" or "dark".
        seconds: Time to wait after the page has loaded [s].

    Raises:
        FileNotFoundError: There is no Chromium.
    """
    program = os.environ.get("CHROMIUM") or shutil.which("chromium")
    if program is None:
        raise FileNotFoundError(
            "no chromium on the path; install it, or name it in the variable CHROMIUM"
        )
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process = subprocess.Popen(
            [program, *_FLAGS, f"--user-data-dir={folder}", "about:blank"],
            stderr=subprocess.DEVNULL,
        )
        try:
            return _visit(_target(Path(folder)), url, (width, height), scheme, seconds)
        finally:
            process.kill()
            process.wait()


def _target(folder: Path) -> str:
    """Address of the debugger of the first page."""
    end = time.monotonic() + _START_S
    port = folder / "DevToolsActivePort"
    while not port.is_file() or not port.read_text().strip():
        if time.monotonic() > end:
            raise TimeoutError(f"Chromium did not start within {_START_S:g} s")
        time.sleep(0.05)
    number = port.read_text().split()[0]
    with urlopen(f"http://127.0.0.1:{number}/json/list", timeout=_START_S) as answer:
        pages = json.load(answer)
    return next(page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page")


def _visit(debugger: str, url: str, size: tuple[int, int], scheme: str, seconds: float) -> Visit:
    errors: list[str] = []
    requests: list[str] = []
    with connect(debugger, max_size=None) as socket:
        number = 0

        def hear(until: int | None, end: float) -> dict[str, Any]:
            while True:
                try:
                    said = json.loads(socket.recv(timeout=max(end - time.monotonic(), 0.01)))
                except TimeoutError:
                    if until is None:
                        return {}
                    raise
                if said.get("id") == until and until is not None:
                    return said["result"]
                _note(said, errors, requests)

        def ask(method: str, **parameters: Any) -> dict[str, Any]:
            nonlocal number
            number += 1
            socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
            return hear(number, time.monotonic() + _START_S)

        for domain in ("Runtime", "Network", "Page", "Log"):
            ask(f"{domain}.enable")
        width, height = size
        ask(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 500,
        )
        ask(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": scheme}],
        )
        if said := ask("Page.navigate", url=url).get("errorText"):
            errors.append(f"{url}: {said}")
        hear(None, time.monotonic() + seconds)
        wider = (
            "Math.max(0, document.documentElement.scrollWidth -"
            " document.documentElement.clientWidth)"
        )
        overflow = ask("Runtime.evaluate", expression=wider)["result"]["value"]
        picture = base64.b64decode(ask("Page.captureScreenshot", format="png")["data"])
    return Visit(picture, errors, requests, int(overflow))


def _note(said: dict[str, Any], errors: list[str], requests: list[str]) -> None:
    method = said.get("method")
    about = said.get("params", {})
    if method == "Runtime.exceptionThrown":
        errors.append(
            about["exceptionDetails"].get("exception", {}).get("description", "exception")
        )
    elif method == "Runtime.consoleAPICalled" and about["type"] in {"error", "assert"}:
        errors.append(" ".join(str(argument.get("value", "")) for argument in about["args"]))
    elif method == "Log.entryAdded" and about["entry"]["level"] == "error":
        errors.append(about["entry"]["text"])
    elif method == "Network.requestWillBeSent":
        requests.append(about["request"]["url"])


def main(arguments: Sequence[str]) -> None:
    """Visit and say what was found."""
    url, picture, *others = arguments
    defaults = ["1200", "800", "light", "3"]
    width, height, scheme, seconds = [*others, *defaults[len(others) :]]
    found = visit(url, int(width), int(height), scheme, float(seconds))
    Path(picture).write_bytes(found.picture)
    print(
        f"wrote {picture}; {found.overflow} pixels too wide; {len(found.requests)} requests;"
        f" errors: {found.errors}"
    )


if __name__ == "__main__":
    main(sys.argv[1:])
