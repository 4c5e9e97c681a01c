"""What the dashboard costs while somebody looks at it, and how soon its page is there.

A page is what a browser fetches (scripts and styles too), and then the live view's WebSocket until the arm's state has
come. The live view is watched like a browser does: every message is taken, compression is agreed on. The control
process is weighed with and without a page that looks.
"""

import contextlib
import http.client
import json
import re
import shutil
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from armctl.client import Client
from armctl.errors import ArmctlError
from proving.dashboard import Dashboard, dashboard
from proving.figures import check, row
from proving.jitter_bench import cpu_s
from proving.load import ticks_between

SECONDS = 20.0
ROUNDS = 5
SETTLE_S = 2.0
LIVE_CPU_BOUND = 0.05
PAGE_BOUND_S = 1.0
PAGE_BOUND_KB = 1200.0
# More of a core than this the control process does not use because somebody looks: what two runs differ by anyway.
TICK_CPU_BOUND = 0.005
SCRIPTS = ("app", "charts", "drive", "live", "scene", "three", "uplot")
FILES = ("/", "/style.css", "/uplot.css", *(f"/{name}.js" for name in SCRIPTS))
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")


def bench(seed: int, seconds: float = SECONDS, rounds: int = ROUNDS) -> dict[str, Any]:
    """Rows and checks; `ratio` is to the bound, and of what has none to the row above it."""
    with tempfile.TemporaryDirectory(prefix="armctl-") as name, contextlib.ExitStack() as cleanup:
        running = cleanup.enter_context(dashboard(Path(name), seed))
        with Client(running.socket) as client:
            control_pid = client.call("status")["pids"]["control"]
        time.sleep(SETTLE_S)
        pages = [_page(running) for _ in range(rounds)]
        usable_s = _usable_in_chromium(running, rounds)
        idle = _cost(running, control_pid, seconds)
        with _watching(running) as received:
            live = _cost(running, control_pid, seconds)
            rate_hz = received[0] / seconds
        cleanup.close()  # and with it the log
        late = [ticks_between(Path(name) / "logs", one["begin_s"], one["end_s"]) for one in (idle, live)]
    size, page_s = pages[0][0], max(seconds for _, seconds in pages)
    more = live["control"] - idle["control"]
    rows = [
        row("live view", "messages", rate_hz, "1/s", rate_hz / 10.0),
        row("live view", "armctl web", 100.0 * live["web"], "% of a core", live["web"] / LIVE_CPU_BOUND),
        row("nobody looks", "armctl web", 100.0 * idle["web"], "% of a core", idle["web"] / LIVE_CPU_BOUND),
        row("nobody looks", "control", 100.0 * idle["control"], "% of a core", 1.0),
        row("live view", "control", 100.0 * live["control"], "% of a core", live["control"] / idle["control"]),
        row("lateness p99, nobody looks", "control", late[0]["lateness_ms_p99"], "ms", 1.0),
        row(
            "lateness p99, live view",
            "control",
            late[1]["lateness_ms_p99"],
            "ms",
            late[1]["lateness_ms_p99"] / late[0]["lateness_ms_p99"],
        ),
        row("first page", "scripts and styles too, packed", size / 1e3, "kB", size / 1e3 / PAGE_BOUND_KB),
        row("first page and state, the slowest", "HTTP client", page_s, "s", page_s / PAGE_BOUND_S),
    ]
    checks = [
        check("live view's CPU in the web process [core]", live["web"], LIVE_CPU_BOUND),
        check("what the live view adds in the control process [core]", more, TICK_CPU_BOUND),
        check("ticks skipped while somebody looks", float(late[1]["skipped_ticks"]), 0.0),
        check("first page and state [s]", page_s, PAGE_BOUND_S),
        check("first page, packed [kB]", size / 1e3, PAGE_BOUND_KB),
    ]
    if usable_s is not None:
        rows.append(row("page usable, median", "Chromium", usable_s, "s", usable_s / PAGE_BOUND_S))
        checks.append(check("page usable in Chromium, median [s]", usable_s, PAGE_BOUND_S))
    return {"rows": rows, "checks": checks, "seed": seed}


def _cost(running: Dashboard, control_pid: int, seconds: float) -> dict[str, float]:
    """Share of a core that each process used, and when."""
    pids = {"web": running.web.pid, "control": control_pid}
    before = {who: cpu_s(pid) for who, pid in pids.items()}
    begin_s = time.monotonic()
    time.sleep(seconds)
    end_s = time.monotonic()
    used = {who: (cpu_s(pid) - before[who]) / (end_s - begin_s) for who, pid in pids.items()}
    return {**used, "begin_s": begin_s, "end_s": end_s}


def _page(running: Dashboard) -> tuple[int, float]:
    """Bytes of the first page, and how long until it knows the arm's state [s]."""
    begin_s, size = time.monotonic(), 0
    connection = http.client.HTTPConnection("127.0.0.1", running.port, timeout=10.0)
    for path in FILES:
        connection.request("GET", path, headers={"Accept-Encoding": "gzip"})
        answer = connection.getresponse()
        size += len(answer.read())
        if answer.status != 200:
            raise ArmctlError(f"{path} was answered with {answer.status}")
    connection.close()
    with _connected(running) as stream:
        while json.loads(stream.recv())["snapshot"] is None:
            pass
    return size, time.monotonic() - begin_s


@contextlib.contextmanager
def _connected(running: Dashboard) -> Iterator[Any]:
    """A page's WebSocket that has said the token."""
    try:
        from websockets.sync.client import connect
    except ImportError as error:
        raise ArmctlError(f"the web bench needs {error.name}; install it with: pip install 'armctl[web]'") from None
    from websockets.typing import Origin

    with connect(f"ws://127.0.0.1:{running.port}/api/stream", origin=Origin(running.address)) as stream:
        stream.send(json.dumps({"token": running.token}))
        yield stream


@contextlib.contextmanager
def _watching(running: Dashboard) -> Iterator[list[int]]:
    """A page that looks; how many messages it has received so far."""
    received = [0]
    ending = threading.Event()

    def watch() -> None:
        with _connected(running) as stream:
            while not ending.is_set():
                stream.recv()
                received[0] += 1

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield received
    finally:
        ending.set()
        watcher.join()


def _usable_in_chromium(running: Dashboard, rounds: int) -> float | None:
    """How long a browser takes from the address to the arm's state on the screen [s]; None: there is no browser.

    Each round is a browser profile that has seen nothing yet.
    """
    path = next((found for name in CHROMIUM if (found := shutil.which(name))), None)
    try:
        from playwright.sync_api import expect, sync_playwright
    except ImportError:
        return None
    if path is None:
        return None
    took_s = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
        for _ in range(rounds):
            context = browser.new_context()
            page = context.new_page()
            begin_s = time.monotonic()
            page.goto(f"{running.address}/#token={running.token}", wait_until="commit")
            expect(page.locator("#tick")).to_have_text(re.compile("^[0-9]+$"), timeout=30_000)
            took_s.append(time.monotonic() - begin_s)
            context.close()
        browser.close()
    return statistics.median(took_s)
