"""A headless chromium, driven over its debugging pipe (Chrome DevTools Protocol).

No driver, no port, no package.
"""

import json
import os
import select
import shutil
import subprocess
import time
from contextlib import contextmanager

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-extensions",
    "--disable-background-networking",
    "--no-first-run",
    "--mute-audio",
    "--remote-debugging-pipe",
    "--window-size=1200,900",
]
_PATIENCE_S = 60.0


class Page:
    """One page.

    ``errors`` collects exceptions, console errors and every request that is not the page's own
    file.
    """

    def __init__(self, commands, answers):
        self._commands, self._answers = commands, answers
        self._rest, self._number, self._session = b"", 0, None
        self.errors = []
        target = self._send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._send("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._send(f"{domain}.enable")

    def open(self, path):
        self._url = path.as_uri()
        self._send("Page.navigate", url=self._url)
        self.wait_for("document.readyState === 'complete' && location.protocol === 'file:'")

    def value(self, expression):
        """What a JavaScript expression gives."""
        told = self._send(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in told, told["exceptionDetails"]
        return told["result"].get("value")

    def wait_for(self, expression):
        """Until an expression is true."""
        end = time.monotonic() + _PATIENCE_S
        while not self.value(expression):
            assert time.monotonic() < end, f"still not so after {_PATIENCE_S} s: {expression}"
            time.sleep(0.05)

    def size(self, width, height):
        """Give the page this many CSS pixels."""
        self._send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def click(self, selector):
        """A real click into the middle of an element."""
        x, y, width, height = self.value(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            "e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect();"
            "return [b.x, b.y, b.width, b.height]; })()"
        )
        at = {"x": x + width / 2, "y": y + height / 2, "button": "left", "clickCount": 1}
        for kind in ("mousePressed", "mouseReleased"):
            self._send("Input.dispatchMouseEvent", type=kind, **at)

    def key(self, key, **more):
        """A real key stroke."""
        for kind in ("keyDown", "keyUp"):
            self._send("Input.dispatchKeyEvent", type=kind, key=key, **more)

    def _send(self, method, **parameters):
        """A command; its result. Events that come meanwhile are looked at."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while True:
            told = self._receive()
            if told.get("id") == self._number:
                assert "error" not in told, (method, told["error"])
                return told["result"]
            self._note(told)

    def _receive(self):
        end = time.monotonic() + _PATIENCE_S
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._answers], [], [], max(0.0, end - time.monotonic()))
            assert ready, "the browser does not answer"
            read = os.read(self._answers, 1 << 20)
            assert read, "the browser has ended"
            self._rest += read
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)

    def _note(self, event):
        told, method = event.get("params", {}), event.get("method")
        if method == "Runtime.exceptionThrown":
            self.errors.append(told["exceptionDetails"])
        elif method == "Log.entryAdded" and told["entry"]["level"] == "error":
            self.errors.append(told["entry"])
        elif method == "Runtime.consoleAPICalled" and told["type"] in ("error", "assert"):
            self.errors.append(told)
        elif method == "Network.requestWillBeSent":
            url = told["request"]["url"]
            if url != getattr(self, "_url", None) and not url.startswith(("data:", "about:")):
                self.errors.append(f"request to {url}")


@contextmanager
def browser_page(profile):
    """A page in a browser of its own, which ends with the block; without a chromium it skips."""
    browser = next((path for name in NAMES if (path := shutil.which(name))), None)
    if browser is None:
        pytest.skip("no chromium found; CI installs it: apt-get install chromium")
    # The descriptors of the pipe are 3 and 4 in the browser; here they must be others.
    placeholders = [os.open(os.devnull, os.O_RDONLY) for _ in range(3)]
    (read_commands, commands), (answers, write_answers) = os.pipe(), os.pipe()
    closed = (*placeholders, read_commands, write_answers)
    assert min(closed) >= 3

    def as_three_and_four():
        os.dup2(read_commands, 103)
        os.dup2(write_answers, 104)
        os.dup2(103, 3)
        os.dup2(104, 4)

    process = subprocess.Popen(
        [browser, *FLAGS, f"--user-data-dir={profile}", "about:blank"],
        **dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL),
        preexec_fn=as_three_and_four,
        pass_fds=(3, 4),
        start_new_session=True,
    )
    for descriptor in closed:
        os.close(descriptor)
    try:
        yield Page(commands, answers)
    finally:
        os.killpg(process.pid, 9)
        process.wait(timeout=30)
        os.close(commands)
        os.close(answers)
