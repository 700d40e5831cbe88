"""Chromium without a window, told what to do through a pipe (its DevTools protocol): pictures of pages that live."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from pathlib import Path

import cv2
import numpy as np

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = [
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"),
    *("--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"),
    # Chromium calls its makers on its own; no name resolves, so nothing leaves this machine.
    *("--disable-quic", "--no-proxy-server", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"),
]


class Browser:
    """One page. `requests` : addresses that it asked for, by number, less those that its own policy forbade"""

    def __init__(self, profile: Path, width: int = 1200, height: int = 800) -> None:
        assert CHROMIUM is not None
        to_browser, self._out = os.pipe()
        self._in, from_browser = os.pipe()
        # Chromium reads its descriptor 3 and writes to its 4
        command = ["bash", "-c", f'exec "$@" 3<&{to_browser} 4>&{from_browser}', "bash", CHROMIUM, *FLAGS]
        self._process = subprocess.Popen(
            [*command, "--remote-debugging-pipe", f"--user-data-dir={profile}", f"--window-size={width},{height}"],
            pass_fds=(to_browser, from_browser), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_browser)
        os.close(from_browser)
        os.set_blocking(self._in, False)
        self._buffer, self._id, self._session = b"", 0, None
        self.requests: dict[str, str] = {}
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Network.enable")
        self.call("Page.enable")

    def call(self, method: str, timeout_s: float = 60.0, **parameters):
        """What the browser answers."""
        self._id += 1
        message = {"id": self._id, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            for answer in self._read():
                if answer.get("id") == self._id:
                    assert "error" not in answer, answer
                    return answer["result"]
        raise TimeoutError(method)

    def wait(self, seconds: float) -> None:
        """Let the page live, and note what it asks for."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self._read()

    def picture(self) -> np.ndarray:
        """(H, W, 3) BGR of what is to be seen now."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._in)
        os.close(self._out)

    def _read(self) -> list[dict]:
        try:
            self._buffer += os.read(self._in, 1 << 20)
        except BlockingIOError:
            time.sleep(0.02)
        *whole, self._buffer = self._buffer.split(b"\0")
        answers = [json.loads(text) for text in whole]
        for answer in answers:
            if answer.get("method") == "Network.requestWillBeSent":
                self.requests[answer["params"]["requestId"]] = answer["params"]["request"]["url"]
            if answer.get("method") == "Network.loadingFailed" and answer["params"].get("blockedReason") == "csp":
                self.requests.pop(answer["params"]["requestId"], None)
        return answers
