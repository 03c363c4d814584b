"""A headless Chromium, driven by its DevTools protocol over one WebSocket."""

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from contextlib import ExitStack

from websockets.sync.client import connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

_START_S = 240.0


class Browser:
    """One page in one browser; `folder` is for its profile."""

    def __init__(self, folder, size=(1280, 900)):
        self._stack = ExitStack()
        self._number = 0
        self.errors = []
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"]
        self._process = subprocess.Popen(
            [CHROMIUM, *options, "--remote-debugging-port=0", f"--user-data-dir={folder}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._stack.callback(self._end)
        try:
            port = _port(folder, self._process)
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=120) as answer:
                target = next(one for one in json.load(answer) if one["type"] == "page")
            address = target["webSocketDebuggerUrl"]
            self._socket = self._stack.enter_context(connect(address, max_size=1 << 26, compression=None))
            for domain in ("Page", "Runtime", "Log"):
                self.call(f"{domain}.enable")
            self.resize(*size)
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stack.close()

    def call(self, method, **parameters):
        """Call the protocol; what the page reports as an error meanwhile is put into `errors`."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]
            if message.get("method") == "Runtime.exceptionThrown":
                self.errors.append(message["params"]["exceptionDetails"])
            if message.get("method") == "Log.entryAdded" and message["params"]["entry"]["level"] == "error":
                self.errors.append(message["params"]["entry"]["text"])

    def open(self, url):
        """Load a page."""
        self.call("Page.navigate", url=url)

    def resize(self, width, height, *, phone=False):
        """Take a size, in CSS pixels."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=phone)

    def value(self, expression):
        """Return the value of a JavaScript expression."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def until(self, expression, timeout_s=120.0):
        """Wait until an expression is true; return its value."""
        end_s = time.monotonic() + timeout_s
        while not (value := self.value(expression)):
            assert time.monotonic() < end_s, f"never: {expression}"
            time.sleep(0.1)
        return value

    def click(self, selector, across=0.5):
        """Click on an element, with the mouse, at a share of its width."""
        script = "(e => {e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect();"
        script += f" return [b.x + b.width * {across}, b.y + b.height / 2];}})(document.querySelector('{selector}'))"
        x, y = self.value(script)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, key, code, number):
        """Press a key and let it go."""
        text = {"text": key} if len(key) == 1 else {}
        event = {"key": key, "code": code, "windowsVirtualKeyCode": number}
        self.call("Input.dispatchKeyEvent", type="keyDown", **event, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", **event)

    def screenshot(self, path, *, whole=False):
        """Save what is seen as PNG."""
        picture = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(picture["data"]))

    def _end(self):
        self._process.terminate()
        try:
            self._process.wait(60)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _port(folder, process):
    """Return the port that the browser has written into its profile."""
    end_s = time.monotonic() + _START_S
    path = folder / "DevToolsActivePort"
    while not (path.exists() and path.read_text().count("\n")):
        assert process.poll() is None, "the browser has ended"
        assert time.monotonic() < end_s, "the browser does not start"
        time.sleep(0.1)
    return int(path.read_text().split()[0])
