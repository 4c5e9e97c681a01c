"""The dashboard in a browser, by itself: from the first question of the set-up to a corrected straight line.

| trial | what is done | bound |
|-|-|-|
| journey | an arm that nobody has set up; all by the page, by mouse and finger | clicks; the true tool off its line |
| cut off | the connection of a held button is lost: closed, or silent | the true tool stands |
| clicked | STOP, again and again, beside all that `load.py` does | 99 of 100 clicks are served |

A click, a touch and a field that is written count one each. The line is judged by where the simulator says that the
tool truly was: by its mean distance from its own best line. That from the wanted one, which is as exact as a hand holds
the arm for its zeros, and the largest distances are told.

STOP counts from the click's own time stamp to the last byte of the answer, by the browser's one clock. The browser runs
on the very processors that the load fills, so it has precedence over the load: what is looked at is the server's time.

A connection is lost at any instant between a word of the page and its answer, upon which the next would be sent: it is
closed, or silent from then on.
"""

import contextlib
import http.client
import json
import math
import re
import shutil
import socket
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.synchronize import Lock
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from armctl.client import Client
from armctl.errors import ArmctlError
from armctl.lab.demo import started
from armctl.sim.control import SimulatorClient, control_path
from proving.crowd import STOP_EVERY_S, Place, Stopped
from proving.dashboard import dashboard, pages
from proving.load import prove as prove_load
from proving.rig import hold

MOST_CLICKS = 25
STRAIGHT_MM = 1.5
WAYS = ("silent", "closed")
# How long the tool may go on.
STOPPED_S = 0.2
# Of both ways together.
CUTS = 400
# A tool that is slower stands, by the way of so many samples of 10 ms; it was led faster.
STANDS_M_S, SAMPLES = 0.004, 2
LED_M_S = 0.03
# Less far it was not led.
LEAST_WAY_M = 0.0002
# Between a word and the answer [s].
BETWEEN_S = 0.1
# The joints [deg] from which it is led up and down, none near a limit; it comes back there after so many cuts.
MIDDLE_DEG, ASTRAY = (0.0, 87.0, -65.0, -64.0, -33.0, 0.0), 20
# Arms, the line that each can reach [m], and by what it is driven.
JOURNEYS = tuple(
    (arm, line, size)
    for arm, line in (
        ("phantomx-pincher", ("0.18, -0.125, 0.25", "0.18, 0.125, 0.25")),
        ("ax12-line", ("0.18, -0.125, 0.1", "0.18, 0.125, 0.1")),
    )
    for size in ("desk", "phone")
)
SERVED_MS = 100.0
LEAST_STOPS = 200
CLICKING_S, FEWEST_CLICKS = 120.0, 2
PRECEDENCE = "nice -n -15"
# When STOP was clicked, and when the answer had come and how it was [ms].
LISTEN = """() => {
  Object.assign(window, { clicked: [], served: [] });
  document.getElementById("stop").addEventListener("click", (event) => clicked.push(event.timeStamp), true);
  new PerformanceObserver((list) => {
    const stops = list.getEntries().filter(({ name }) => name.endsWith("/api/stop"));
    served.push(...stops.map(({ responseEnd, responseStatus }) => [responseEnd, responseStatus]));
  }).observe({ type: "resource" });
}"""
ANSWERED = """() => new Promise((done) => {
  const look = () => clicked.length === served.length ? done() : setTimeout(look, 5);
  look();
})"""
FLAGS = ("--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
PATIENCE_MS = 120_000
SET_UP_MS = 900_000


# ------------------------------------------------------------------------------------------------- the journey


@dataclass
class Finger:
    """Who uses the page, and how often so far."""

    page: Any
    touches: bool
    clicks: int = 0

    def press(self, what: str) -> None:
        self.clicks += 1
        if self.touches:
            self.page.tap(what)
        else:
            self.page.click(what)

    def write(self, where: str, text: str) -> None:
        self.clicks += 1
        self.page.fill(where, text)


@contextlib.contextmanager
def browsed(phone: bool, before: str = "") -> Iterator[Any]:
    """A page of Chromium.

    Args:
        before: Words of a shell that start it.
    Raises:
        ArmctlError: there is no browser, or nothing that drives it.
    """
    path = next((found for name in CHROMIUM if (found := shutil.which(name))), None)
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        path = None
    if path is None:
        raise ArmctlError("this proof needs Chromium and playwright: sudo apt install chromium, pip install playwright")
    with sync_playwright() as playwright, tempfile.TemporaryDirectory(prefix="armctl-") as folder:
        start = Path(folder) / "chromium"
        start.write_text(f'#!/bin/sh\nexec {before} {path} "$@"\n', encoding="utf-8")
        start.chmod(0o700)
        browser = playwright.chromium.launch(executable_path=start, args=FLAGS)
        width, height = (390, 844) if phone else (1440, 900)
        size: Any = {"width": width, "height": height}
        page = browser.new_context(viewport=size, has_touch=phone, is_mobile=phone).new_page()
        page.set_default_timeout(PATIENCE_MS)
        yield page
        browser.close()


def journey(seed: int, arm: str, line: tuple[str, str], size: str) -> dict[str, Any]:
    """From an arm that nobody has set up to a corrected line, by the page alone."""
    begin_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="armctl-") as name, contextlib.ExitStack() as cleanup:
        folder = Path(name)
        servos, config = folder / "servos", folder / "armctl.yaml"
        config.write_text(yaml.safe_dump({"port": str(servos), "data_dir": str(folder)}), encoding="utf-8")
        simulator = ("sim", "--arm", arm, "--link", str(servos), "--seed", str(seed))
        cleanup.enter_context(started(folder / "simulator.log", *simulator))
        common = ("--config", str(config), "--socket", str(folder / "daemon.sock"))
        _, port, token = cleanup.enter_context(pages(folder / "web.log", *common, own=folder / "own"))
        page = cleanup.enter_context(browsed(size == "phone"))
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(f"http://127.0.0.1:{port}/#token={token}")
        finger = Finger(page, size == "phone")
        answer = _by_the_page(finger, arm, line)
        with SimulatorClient(control_path(servos)) as truth:
            tool_m = truth.truth(answer["begin_ns"], answer["end_ns"]).tool_m
    own_mm, wanted_mm = off_line_mm(tool_m, line)
    return {"arm": arm, "size": size, "clicks": finger.clicks, "own_mean_mm": own_mm[0], "own_max_mm": own_mm[1],
            "wanted_mean_mm": wanted_mm[0], "wanted_max_mm": wanted_mm[1], "encoders_mm": answer["mean_error_mm"],
            "seconds": round(time.monotonic() - begin_s), "errors": errors}  # fmt: skip


def _by_the_page(finger: Finger, arm: str, line: tuple[str, str]) -> dict[str, Any]:
    """What the daemon answered to the run."""
    from playwright.sync_api import expect

    page = finger.page
    expect.set_options(timeout=PATIENCE_MS)
    finger.press("nav [data-view=setup]")
    finger.press("#setup-go")
    finger.press(f"#setup-choices button:text-is('{arm}')")
    finger.write("#setup-word", "mine")
    finger.press("#setup-choices button")
    finger.press("#setup-hand")
    expect(page.locator("#setup-done")).to_be_visible(timeout=SET_UP_MS)
    finger.press("#setup-start")
    expect(page.locator("#state")).to_have_text("off")
    finger.press("nav [data-view=guide]")
    finger.write("#line-form [name=from]", line[0])
    finger.write("#line-form [name=to]", line[1])
    finger.press("#teach-begin")
    expect(page.locator("#state")).to_have_text("teaching")
    for take in range(3):
        finger.press("#take-by-hand")
        expect(page.locator("#takes li")).to_have_count(take + 1)
    finger.press("#teach-end")
    expect(page.locator("#state")).to_have_text("off")
    finger.press("#optimise-form [type=submit]")
    expect(page.locator("#plan-choice")).to_have_value(re.compile("^line-via"))
    with page.expect_response(re.compile("/run$"), timeout=SET_UP_MS) as answered:
        finger.press("#refine")
    if not answered.value.ok:
        raise ArmctlError(f"the line was not run: {answered.value.text()}")
    answer: dict[str, Any] = answered.value.json()
    return answer


def off_line_mm(tool_m: np.ndarray, line: tuple[str, str]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Mean and largest distance of the tool from its own best line, and from the wanted one."""
    A, B = (np.array([float(part) for part in end.split(",")]) for end in line)
    middle = tool_m.mean(axis=0)
    own = np.linalg.svd(tool_m - middle)[2][0]
    both = []
    for place, way in ((middle, own), (A, (B - A) / np.linalg.norm(B - A))):
        off = tool_m - place
        away = 1e3 * np.linalg.norm(off - np.outer(off @ way, way), axis=1)
        both.append((round(float(away.mean()), 3), round(float(away.max()), 3)))
    return both[0], both[1]


# ----------------------------------------------------------------------------------------- a connection is lost


def cut_off(seed: int, count: int, tell: Callable[[str], None] = lambda _: None) -> list[dict[str, Any]]:
    """How long the true tool went on after the connection was lost that led it [s]."""
    rng, rows = np.random.default_rng((seed, 53)), list[dict[str, Any]]()
    with (
        tempfile.TemporaryDirectory(prefix="armctl-") as name,
        dashboard(Path(name), seed) as running,
        Client(running.socket) as client,
        SimulatorClient(control_path(Path(name) / "servos")) as simulator,
    ):
        hold(client, 20.0)
        for number in range(count):
            if number % ASTRAY == 0:  # or it would some time be led against the end of its way, which stops it as well
                client.call("move", joints_rad=[math.radians(angle) for angle in MIDDLE_DEG])
            way, side = WAYS[number % 2], 1.0 if number % 4 < 2 else -1.0
            begin_ns = time.monotonic_ns()
            with contextlib.closing(http.client.HTTPConnection("127.0.0.1", running.port, timeout=20.0)) as connection:
                cut_ns = _led(connection, running.token, side * LED_M_S, rng)
                if way == "closed":  # at once, and with a reset
                    connection.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    connection.close()
                time.sleep(1.0)
            truth = simulator.truth(begin_ns, time.monotonic_ns())
            rows.append({"way": way, **stood(truth.time_ns, truth.tool_m, cut_ns)})
            if number % 20 == 19:
                tell(f"{number + 1} of {count}, the slowest {max(row['stopped_s'] for row in rows):.3f} s")
    return rows


def _led(connection: http.client.HTTPConnection, token: str, speed_m_s: float, rng: np.random.Generator) -> int:
    """Lead the tool as a page does, until an instant between a word and its answer; when that was [ns]."""
    headers = {"X-Armctl-Token": token, "Content-Type": "application/json"}
    begin_s, seconds, begun = time.monotonic(), float(rng.uniform(0.4, 1.0)), False
    while True:
        body = json.dumps({"tool_m_s": [0.0, 0.0, speed_m_s], "begin": not begun})
        connection.request("POST", "/api/jog", body, headers)
        if time.monotonic() - begin_s > seconds:
            time.sleep(float(rng.uniform(0.0, BETWEEN_S)))
            return time.monotonic_ns()
        answer = connection.getresponse()
        told = answer.read()
        if answer.status != 200:
            raise ArmctlError(f"the tool is not led: {told.decode()}")
        begun = True


def stood(time_ns: np.ndarray, tool_m: np.ndarray, cut_ns: int) -> dict[str, float]:
    """How long after an instant the tool went on [s], and how far it had gone until then [m]."""
    steps_m = np.linalg.norm(tool_m[SAMPLES:] - tool_m[:-SAMPLES], axis=1)
    moving = np.flatnonzero(steps_m > STANDS_M_S * (time_ns[SAMPLES:] - time_ns[:-SAMPLES]) / 1e9)
    went_m = float(np.linalg.norm(tool_m[np.searchsorted(time_ns, cut_ns) - 1] - tool_m[0]))
    last_ns = int(time_ns[moving[-1] + SAMPLES]) if len(moving) else cut_ns
    return {"stopped_s": round(max(0.0, (last_ns - cut_ns) / 1e9), 3), "went_m": round(went_m, 4)}


# ------------------------------------------------------------------------------------------- STOP under load


def stop_clicked(place: Place, still: Lock, begin_s: float, end_s: float) -> list[Stopped]:
    """Body of a process: click STOP again and again, while nobody moves the arm."""
    stops, clicks = [], 0
    with browsed(phone=False, before=PRECEDENCE) as page:
        page.goto(f"http://127.0.0.1:{place.port}/#token={place.token}")
        # A fault is no reason to wait: STOP is served under one too, and `judged` counts it.
        page.wait_for_selector("#state[data-state]:not([data-state=unreachable])")
        page.evaluate(LISTEN)
        time.sleep(max(0.0, begin_s - time.monotonic()))
        while clicks < FEWEST_CLICKS or time.monotonic() < end_s:  # a browser may take long to start
            with still:
                page.click("#stop")
                page.evaluate(ANSWERED)
            clicks += 1
            time.sleep(STOP_EVERY_S)
        for clicked_ms, [served_ms, status] in page.evaluate("() => clicked.map((at, i) => [at, served[i]])"):
            answered_s = served_ms / 1e3 if status == 200 else math.inf
            stops.append(Stopped("clicked", clicked_ms / 1e3, answered_s))
    return stops


# ------------------------------------------------------------------------------------------------------- all of it


def prove(seed: int, tell: Callable[[str], None]) -> dict[str, Any]:
    """Every journey and every lost connection, and what was beyond its bound."""
    rows = []
    for trial in JOURNEYS:
        rows.append(journey(seed, *trial))
        tell(json.dumps(rows[-1]))
    lost = cut_off(seed, CUTS, tell)
    load = prove_load(seed, CLICKING_S, tell=tell, more={"clicked": stop_clicked})
    clicked = load["more"][0] | {"latched": load["latched"]}
    figures = {
        f"stopped_s_max_{way}": max((row["stopped_s"] for row in lost if row["way"] == way), default=math.nan)
        for way in WAYS
    }
    return {
        "rows": rows,
        **figures,
        "clicked": clicked,
        "other_work_cores": load["other_work_cores"],
        "runs": len(rows) + len(lost) + clicked["stops"],
        "violations": judged(rows, lost, clicked),
        "seed": seed,
    }


def judged(rows: list[dict[str, Any]], lost: list[dict[str, Any]], clicked: dict[str, Any]) -> list[str]:
    """What is beyond its bound."""
    found = [] if clicked["latched"] == 0 else [f"{clicked['latched']:g} faults latched while STOP was clicked"]
    if not clicked["stops"] >= LEAST_STOPS:
        found.append(f"STOP was clicked {clicked['stops']} times, at least {LEAST_STOPS} are wanted")
    if not clicked["ms_p99"] <= SERVED_MS:
        found.append(f"STOP: 99 of 100 clicks were served within {clicked['ms_p99']:.1f} ms, bound {SERVED_MS:g}")
    for row in rows:
        who = f"{row['arm']}, {row['size']}"
        if row["clicks"] > MOST_CLICKS:
            found.append(f"{who}: {row['clicks']} clicks, bound {MOST_CLICKS}")
        if not row["own_mean_mm"] <= STRAIGHT_MM:
            found.append(f"{who}: {row['own_mean_mm']} mm off its line, bound {STRAIGHT_MM}")
        found += [f"{who}: the page failed: {error}" for error in row["errors"]]
    for number, row in enumerate(lost):
        if not row["stopped_s"] <= STOPPED_S:
            found.append(f"cut {number} ({row['way']}): moved for {row['stopped_s']} s, bound {STOPPED_S}")
        if not row["went_m"] > LEAST_WAY_M:
            found.append(f"cut {number} ({row['way']}): it did not move before")
    return found
