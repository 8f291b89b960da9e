"""Runs the study's JavaScript outside a study: in Node where that is installed, else in a headless browser.

The script fetches tasks from a server of this process and posts what it worked out (`assets/task_runner.js`).
"""

from __future__ import annotations

import json
import queue
import shutil
import struct
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any

from popgen.errors import UserError

SCRIPTS = ("kitchen_rules.js", "ego_network.js", "task_runner.js")
"""What a task needs, of popgen/study/assets."""

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
ANSWER_SECONDS = 300
_PAGE = b'<!doctype html><script type="module">import("/task_runner.js").then((m) => m.workOn(""))</script>'
_START = 'import { workOn } from "./task_runner.js";\nawait workOn(process.argv[2]);\n'


class ScriptEngine:
    """A running engine; see `open_engine`.

    Args:
        name: of its program.
        tasks, results: what goes to the script and comes back.
        process: of the engine.
    """

    def __init__(
        self, name: str, tasks: queue.Queue[bytes], results: queue.Queue[bytes], process: subprocess.Popen[bytes]
    ) -> None:
        self.name = name
        self._tasks, self._results, self._process = tasks, results, process

    def run_task(self, task: str, told: Mapping[str, Any], data: bytes = b"") -> bytes:
        """What the script makes of a task.

        Args:
            task: name in task_runner.js.
            told: JSON-able.
            data: bytes beside it.

        Raises:
            UserError: the engine has ended, or does not answer.
        """
        head = json.dumps({"task": task, **told}).encode()
        self._tasks.put(struct.pack("<I", len(head)) + head + data)
        for _ in range(ANSWER_SECONDS * 5):
            try:
                return self._results.get(timeout=0.2)
            except queue.Empty:
                if self._process.poll() is not None:
                    break
        raise UserError(self.name, f"gave no answer to the task {task!r}", "run it by hand to see why")


def find_engine() -> str | None:
    """Path of Node, else of a browser; None where there is neither."""
    return next((path for name in ("node", *BROWSERS) if (path := shutil.which(name))), None)


@contextmanager
def open_engine(program: str | None = None) -> Iterator[ScriptEngine]:
    """Start an engine, and end it with the block.

    Args:
        program: path of Node or of a browser; by default what is installed.

    Raises:
        UserError: there is none.
    """
    program = program or find_engine()
    if program is None:
        raise UserError("JavaScript", "neither Node nor Chromium is installed", "install one of them")
    tasks: queue.Queue[bytes] = queue.Queue()
    results: queue.Queue[bytes] = queue.Queue()
    server = ThreadingHTTPServer(("127.0.0.1", 0), _make_handler(tasks, results))
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            address = f"http://127.0.0.1:{server.server_address[1]}"
            command = _make_command(program, address, Path(folder))
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            try:
                yield ScriptEngine(Path(program).name, tasks, results, process)
            finally:
                process.kill()
                process.wait()
    finally:
        server.shutdown()
        server.server_close()


def _make_command(program: str, address: str, folder: Path) -> list[str]:
    """Node gets copies of the scripts in a package of modules; a browser gets the page that loads them."""
    if Path(program).name not in BROWSERS:
        (folder / "package.json").write_text('{"type": "module"}')
        (folder / "start.js").write_text(_START)
        for name, content in _read_scripts().items():
            (folder / name).write_bytes(content)
        return [program, str(folder / "start.js"), address]
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
    return [program, *flags, f"--user-data-dir={folder}", address]


def _read_scripts() -> dict[str, bytes]:
    return {name: (files("popgen.study") / "assets" / name).read_bytes() for name in SCRIPTS}


def _make_handler(tasks: queue.Queue[bytes], results: queue.Queue[bytes]) -> type[BaseHTTPRequestHandler]:
    pages = {"/": ("text/html", _PAGE)}
    pages |= {f"/{name}": ("text/javascript", content) for name, content in _read_scripts().items()}

    class Handler(BaseHTTPRequestHandler):
        """Gives tasks and takes results."""

        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            """The page, a script, or the next task."""
            if self.path == "/next":
                self._send_answer("application/octet-stream", tasks.get())
            elif self.path in pages:
                self._send_answer(*pages[self.path])
            else:
                self.send_error(404)

        def do_POST(self) -> None:
            """A result."""
            results.put(self.rfile.read(int(self.headers["Content-Length"])))
            self._send_answer("text/plain", b"")

        def _send_answer(self, kind: str, content: bytes) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: Any) -> None:
            """Nothing is printed."""

    return Handler
