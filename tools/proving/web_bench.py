"""What the dashboard costs while somebody looks at it, and how soon its page is there.

A page is what a browser fetches (scripts and styles too), and then the live view's WebSocket until the arm's state has
come. The live view is watched like a browser does: every message is taken, compression is agreed on. The daemon's host
and its control process are weighed with and without a page that looks. Pictures are counted in Chromium, which draws
them without a graphics processor, while the arm moves.
"""

import contextlib
import gzip
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
from proving.page import CHROMIUM, FLAGS
from proving.rig import hold

SECONDS = 20.0
ROUNDS = 5
SETTLE_S = 2.0
LIVE_CPU_BOUND = 0.05
PAGE_BOUND_S = 1.0
PAGE_BOUND_KB = 1200.0
# What somebody who looks may cost the daemon's host.
HOST_CPU_BOUND = 0.03
FRAMES_BOUND_HZ = 20.0
# How long the arm moves while pictures are counted, and how long that takes to begin.
MOVE_S, MOVES_AFTER_S = 10.0, 2.0
SWAY_RAD = 0.8
# More of a core than this the control process does not use because somebody looks: what two runs differ by anyway.
TICK_CPU_BOUND = 0.005
# What else a page fetches, as it says itself.
FILE = re.compile(r'(?:href|src)="(/[^"]+)"')


def bench(seed: int, seconds: float = SECONDS, rounds: int = ROUNDS) -> dict[str, Any]:
    """Rows and checks; `ratio` is to the bound, and of what has none to the row above it."""
    with tempfile.TemporaryDirectory(prefix="armctl-") as name, contextlib.ExitStack() as cleanup:
        running = cleanup.enter_context(dashboard(Path(name), seed))
        with Client(running.socket) as client:
            pids = {**client.call("status")["pids"], "web": running.web.pid}
        time.sleep(SETTLE_S)
        pages = [_page(running) for _ in range(rounds)]
        usable_s, frames_hz = _in_chromium(running, rounds)
        idle = _cost(pids, seconds)
        with _watching(running) as received:
            live = _cost(pids, seconds)
            rate_hz = received[0] / seconds
        cleanup.close()  # and with it the log
        late = [ticks_between(Path(name) / "logs", one["begin_s"], one["end_s"]) for one in (idle, live)]
    size, page_s = pages[0][0], max(seconds for _, seconds in pages)
    more = {who: live[who] - idle[who] for who in ("control", "daemon")}
    rows = [
        row("live view", "messages", rate_hz, "1/s", rate_hz / 10.0),
        row("live view", "armctl web", 100.0 * live["web"], "% of a core", live["web"] / LIVE_CPU_BOUND),
        row("nobody looks", "armctl web", 100.0 * idle["web"], "% of a core", idle["web"] / LIVE_CPU_BOUND),
        row("nobody looks", "control", 100.0 * idle["control"], "% of a core", 1.0),
        row("live view", "control", 100.0 * live["control"], "% of a core", live["control"] / idle["control"]),
        row("nobody looks", "host", 100.0 * idle["daemon"], "% of a core", 1.0),
        row("live view", "host", 100.0 * live["daemon"], "% of a core", live["daemon"] / idle["daemon"]),
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
        check("what the live view adds in the control process [core]", more["control"], TICK_CPU_BOUND),
        check("what the live view adds in the daemon's host [core]", more["daemon"], HOST_CPU_BOUND),
        check("ticks skipped while somebody looks", float(late[1]["skipped_ticks"]), 0.0),
        check("first page and state [s]", page_s, PAGE_BOUND_S),
        check("first page, packed [kB]", size / 1e3, PAGE_BOUND_KB),
    ]
    if usable_s is not None:
        rows.append(row("page usable, median", "Chromium", usable_s, "s", usable_s / PAGE_BOUND_S))
        checks.append(check("page usable in Chromium, median [s]", usable_s, PAGE_BOUND_S))
    if frames_hz is not None:
        rows.append(row("pictures while the arm moves", "Chromium", frames_hz, "1/s", frames_hz / FRAMES_BOUND_HZ))
        checks.append(check("time of a picture while the arm moves [s]", 1.0 / frames_hz, 1.0 / FRAMES_BOUND_HZ))
    return {"rows": rows, "checks": checks, "seed": seed}


def _cost(pids: dict[str, int], seconds: float) -> dict[str, float]:
    """Share of a core that each process used, and when."""
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
    paths = ["/"]
    for path in paths:
        connection.request("GET", path, headers={"Accept-Encoding": "gzip"})
        answer = connection.getresponse()
        packed = answer.read()
        size += len(packed)
        if answer.status != 200:
            raise ArmctlError(f"{path} was answered with {answer.status}")
        if path == "/":
            paths += sorted(set(FILE.findall(gzip.decompress(packed).decode())))
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


def _in_chromium(running: Dashboard, rounds: int) -> tuple[float, float] | tuple[None, None]:
    """How long a browser takes from the address to the arm's state on the screen [s], and how many pictures a second it
    draws while the arm moves; None: there is no browser.

    Each round is a browser profile that has seen nothing yet.
    """
    path = next((found for name in CHROMIUM if (found := shutil.which(name))), None)
    try:
        from playwright.sync_api import expect, sync_playwright
    except ImportError:
        path = None
    if path is None:
        return None, None
    took_s = []
    with sync_playwright() as playwright, Client(running.socket) as client:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        for _ in range(rounds):
            page = browser.new_context().new_page()
            begin_s = time.monotonic()
            page.goto(f"{running.address}/#token={running.token}", wait_until="commit")
            expect(page.locator("#tick")).to_have_text(re.compile("^[0-9]+$"), timeout=30_000)
            took_s.append(time.monotonic() - begin_s)
            if len(took_s) < rounds:
                page.context.close()
        frames_hz = _frames_hz(client, page)
        browser.close()
    return statistics.median(took_s), frames_hz


def _frames_hz(client: Client, page: Any) -> float:
    """Pictures a second that a page draws while the arm moves."""
    hold(client, 20.0)
    q = [joint["position_rad"] for joint in client.call("status")["joints"]]
    to_rad = [q[0] + SWAY_RAD, *q[1:]]
    moving = threading.Thread(target=client.call, args=("move",), kwargs={"joints_rad": to_rad, "duration_s": MOVE_S})
    moving.start()
    time.sleep(MOVES_AFTER_S)
    begin_s, before = time.monotonic(), int(page.get_attribute("#scene", "data-frames"))
    time.sleep(MOVE_S - 2.0 * MOVES_AFTER_S)
    frames_hz = (int(page.get_attribute("#scene", "data-frames")) - before) / (time.monotonic() - begin_s)
    moving.join()
    return frames_hz
