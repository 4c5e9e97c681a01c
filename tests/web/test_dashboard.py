"""The dashboard as a person uses it: a real Chromium, a real daemon, simulated servos."""

import contextlib
import math
import multiprocessing
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, TimeoutError, expect, sync_playwright

from armctl.client import Client
from armctl.errors import RequestRefused
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.lab.table_ii import FROM_M, TO_M
from armctl.sim.control import SimulatorClient, control_path
from armctl.trajectory.collision import link_points
from proving.dashboard import Dashboard, dashboard

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = [
    pytest.mark.pty,
    pytest.mark.crowd,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine: sudo apt install chromium"),
]
FLAGS = (
    "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run",
    "--disable-quic", "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
PATIENCE_MS = 60_000


class Stand:
    """A dashboard that runs, its daemon, and the simulator behind both."""

    def __init__(self, running: Dashboard, simulator: SimulatorClient) -> None:
        self.port, self.token, self.socket = running.port, running.token, running.socket
        self.address = f"{running.address}/#token={running.token}"
        self.simulator = simulator

    def ticks(self, seconds: float) -> None:
        """Let so much of the daemon's time pass."""
        with Client(self.socket) as client:
            snapshots = client.subscribe()
            first = next(snapshots)
            for snapshot in snapshots:
                if (snapshot["tick"] - first["tick"]) * snapshot["period_s"] >= seconds:
                    return


@pytest.fixture(scope="module")
def stand(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stand]:
    folder = tmp_path_factory.mktemp("web")
    with dashboard(folder, seed=4) as running, SimulatorClient(control_path(folder / "servos")) as simulator:
        yield Stand(running, simulator)


def acknowledge(stand: Stand) -> None:
    """Clear a fault as a person would: servos that a busy machine kept waiting too long latch one, at any time."""
    with Client(stand.socket) as client:
        while client.call("status")["fault"] is not None:
            with contextlib.suppress(RequestRefused):  # its cause is not over yet
                client.call("clear")
            stand.ticks(0.2)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def page(browser: Browser, stand: Stand) -> Iterator[Page]:
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    page = context.new_page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.set_default_timeout(PATIENCE_MS)
    expect.set_options(timeout=PATIENCE_MS)
    page.goto(stand.address)
    expect(page.locator("#tick")).not_to_have_text("–")
    acknowledge(stand)  # now that the page's libraries are loaded, which keeps a small machine busy
    yield page
    context.close()
    assert errors == []


def begin_to_teach(page: Page, stand: Stand) -> None:
    """Let the arm go limp as a person would, who clears first what a busy machine latched meanwhile."""
    while True:
        acknowledge(stand)
        with contextlib.suppress(TimeoutError):  # the button waits for a state in which it may be pressed
            page.click("#teach-begin", timeout=5_000)
            return


def state(page: Page, *wanted: str) -> None:
    expect(page.locator("#state")).to_have_text(re.compile("^(" + "|".join(wanted) + ")$"))


def test_from_teaching_to_a_run_and_its_log(page: Page, stand: Stand) -> None:
    page.click("nav [data-view=guide]")
    begin_to_teach(page, stand)
    state(page, "teaching")
    # Begun before the hand sets off for A: however slow the page is, nothing of the line is missed.
    page.click("#take")
    expect(page.locator("#take")).to_have_text("End the take")
    stand.ticks(stand.simulator.guide(FROM_M, TO_M, seed=0).end_s + 0.5)
    page.click("#take")
    expect(page.locator("#takes li")).to_have_count(1)
    page.click("#take-by-hand")
    expect(page.locator("#takes li")).to_have_count(2)
    with Client(stand.socket) as client:  # which says the same of it
        told = client.call("recordings_show", name="line-1", from_m=FROM_M, to_m=TO_M)
    expect(page.locator("#takes li").first).to_contain_text(f"{told['mean_error_mm']:.1f} mm off the wanted line")
    page.click("#teach-end")
    state(page, "off")
    page.fill("#optimise-form [name=via]", "1")
    page.click("#optimise-form [type=submit]")
    expect(page.locator("#optimise-figures")).to_contain_text("exact optimum")
    expect(page.locator("#convergence .names li")).to_have_count(2)
    expect(page.locator("#plan-choice")).to_have_value("line-via1")
    acknowledge(stand)  # the optimisation, too, keeps a small machine busy
    page.click("#run")
    state(page, "moving")
    expect(page.locator("#run-figures")).to_contain_text("off the wanted line on average")
    expect(page.locator("#run-plot .names li")).to_have_count(2)
    state(page, "holding")

    page.click("nav [data-view=compare]")
    page.check("#recordings [aria-label='show line-1']")
    page.check("#plans [aria-label='show line-via1']")
    expect(page.locator("#deviation .names li")).to_have_count(2)
    # Its table says the same again, by the same line.
    figures = page.locator("#recordings tr", has=page.get_by_label("show line-1", exact=True)).locator("td")
    expect(figures.nth(1)).to_have_text(f"{told['mean_error_mm']:.1f}")
    expect(figures.nth(2)).to_have_text(f"{told['max_error_mm']:.1f}")

    page.click("nav [data-view=logs]")
    expect(page.locator("#log-plot .names li")).to_have_count(6)
    page.locator("#scrub").fill("0")
    expect(page.locator("#scrub-time")).to_have_text("0.0 s")
    page.click("#log-play")
    expect(page.locator("#scrub-time")).not_to_have_text("0.0 s")
    page.click("#log-play")
    expect(page.locator("#log-play")).to_have_text("Play")
    page.locator("#scrub").fill("0")
    page.locator("#log-events li", has_text="PLAN_BEGIN").last.get_by_role("button").click()
    expect(page.locator("#scrub-time")).not_to_have_text("0.0 s")
    page.select_option("#log-beside", index=1)
    page.fill("#log-words", "code:PLAN_END")
    page.click("#log-form [type=submit]")
    expect(page.locator("#log-found li")).not_to_have_count(0)
    page.locator("#log-found li").first.get_by_role("button").click()
    expect(page.locator("#log-found-hint")).to_contain_text("found")
    page.fill("#log-words", "servo:x")
    page.click("#log-form [type=submit]")
    expect(page.locator("#log-words-problem")).to_contain_text("servo:x: cannot be understood")


BALL = """async () => {
  const { page: { view: { dots, camera, renderer } } } = await import("/page.js");
  const { x, y } = dots.children[0].position.clone().project(camera);
  const canvas = renderer.domElement.getBoundingClientRect();
  return [(x + 1) / 2 * canvas.width + canvas.left, (1 - y) / 2 * canvas.height + canvas.top];
}"""


def test_an_intermediate_point_is_led_elsewhere_by_dragging_it_or_by_its_place(page: Page) -> None:
    page.click("nav [data-view=guide]")
    page.select_option("#plan-choice", "line-via1")
    expect(page.locator("#bend-place")).not_to_have_value("")
    before = page.locator("#bend-place").input_value()
    page.locator("#scene").scroll_into_view_if_needed()
    x, y = page.evaluate(BALL)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 10, y - 12, steps=4)
    page.mouse.up()
    expect(page.locator("#plan-choice")).to_have_value("line-via1-bent1")
    expect(page.locator("#bend-place")).not_to_have_value(before)
    page.fill("#bend-place", "900, 0, 100")
    page.click("#bend-form [type=submit]")
    expect(page.locator("#bend-place-problem")).to_contain_text("UNREACHABLE")
    expect(page.locator("#bend-place")).not_to_have_value("900, 0, 100")
    page.select_option("#plan-choice", "line-via1")


def test_a_plan_is_refined_told_run_by_run_stopped_between_two_and_nothing_is_lost(page: Page, stand: Stand) -> None:
    state(page, "holding", "off")
    page.click("nav [data-view=guide]")
    page.select_option("#plan-choice", "line-via1")
    page.fill("#refine-most", "1")
    page.click("#refine")
    state(page, "moving")
    expect(page.locator("#run")).to_be_disabled()
    # A busy machine may have disturbed the first run, which then counts but teaches nothing.
    expect(page.locator("#run-figures")).to_contain_text(re.compile("after [12] of at most 2 runs"))
    expect(page.locator("#run-figures")).to_contain_text(re.compile("best of [12] runs"))
    expect(page.locator("#run-plot .names li")).to_have_count(2)
    expect(page.locator("#plan-choice")).to_have_value(re.compile("^refined-via-1-"))
    expect(page.locator("#run")).to_be_enabled()

    page.fill("#refine-most", "3")
    page.click("#refine")
    expect(page.locator("#run-figures")).to_contain_text(re.compile("after [1-3] of at most 4 runs"))
    page.keyboard.press("Escape")
    expect(page.locator("#run-figures")).to_contain_text("ended before its time: STOPPED")
    expect(page.locator("#run-figures")).to_contain_text("off the wanted line on average")
    state(page, "holding")
    page.select_option("#plan-choice", "line-via1")


def test_stop_is_served_under_load_while_the_arm_moves(page: Page, stand: Stand) -> None:
    state(page, "holding", "off")
    page.click("nav [data-view=guide]")
    expect(page.locator("#plan-choice")).not_to_have_value("")
    page.select_option("#plan-choice", "line-via1")
    context = multiprocessing.get_context("spawn")
    begun, ending = context.Event(), context.Event()
    flood = context.Process(target=_flood, args=(stand.port, stand.token, begun, ending), daemon=True)
    flood.start()
    try:
        assert begun.wait(PATIENCE_MS / 1000)
        page.click("#run")
        state(page, "moving")
        page.keyboard.press("Escape")
        state(page, "holding")
        held_ns = time.monotonic_ns()
        expect(page.locator("#run-figures")).to_contain_text("stopped, as somebody asked")
        expect(page.locator("#message")).to_be_hidden()  # that is no failure
    finally:
        ending.set()
        flood.join()
    assert flood.exitcode == 0, "each of the flood's questions was answered"
    stand.ticks(1.5)
    truth = stand.simulator.truth(held_ns + 500_000_000, time.monotonic_ns())
    assert len(truth.tool_m)
    assert abs(truth.tool_m - truth.tool_m[-1]).max() < 0.002, "half a second after STOP held the arm it still moves"


def _flood(port: int, token: str, begun: Any, ending: Any) -> None:
    """Four clients that ask 20 times a second each, in a session of their own as strangers have one."""
    os.setsid()
    address, headers = f"http://127.0.0.1:{port}/api/recordings", {"X-Armctl-Token": token}

    def ask(_: int) -> None:
        while not ending.wait(0.05):
            httpx.get(address, headers=headers, timeout=30.0, trust_env=False).raise_for_status()
            begun.set()

    with ThreadPoolExecutor(4) as clients:
        list(clients.map(ask, range(4)))


def energised(page: Page) -> None:
    """Hold the arm as a person would: one that still sinks, or was not heard by a busy machine, says so."""
    state(page, "holding", "off")
    while page.locator("#state").inner_text() == "off":
        page.click("[data-command=torque-on]")
        expect(page.locator("#state[data-state=holding], #message:not([hidden])").first).to_be_visible()
        if page.locator("#message").is_visible():
            expect(page.locator("#message")).to_contain_text(re.compile("hold the arm still|answered just now"))
    state(page, "holding")


def test_a_slider_shows_where_the_arm_would_go_and_a_click_sends_it_there(page: Page, stand: Stand) -> None:
    energised(page)
    slider = page.get_by_label("where roll is to be, degrees")
    slider.fill("-25")
    expect(page.locator("#go")).to_be_enabled()
    page.click("#go-reset")
    expect(page.locator("#go")).to_be_disabled()
    slider.fill("-25")
    drawn = int(page.locator("#scene").get_attribute("data-frames") or 0)
    go(page, lambda: state(page, "moving"))
    assert abs(math.degrees(stand.simulator.state()["joints_rad"][-1]) + 25.0) < 2.0
    assert int(page.locator("#scene").get_attribute("data-frames") or 0) > drawn
    expect(page.locator("#move-problem")).to_be_hidden()


def go(page: Page, watch: Callable[[], None]) -> None:
    """Send the arm where the sliders are, and watch it; again where a busy machine kept the daemon silent."""
    while True:
        with page.expect_response("**/api/move") as answered:
            page.click("#go")
            watch()
        state(page, "holding")
        if answered.value.ok:
            return
        assert answered.value.json()["error"]["code"] == "HOST_SILENT"


@pytest.mark.parametrize(("place", "reason"), [("900, 0, 100", "UNREACHABLE"), ("180, x, 100", "is no place")])
def test_why_the_tool_cannot_go_somewhere_stands_beside_the_button(page: Page, place: str, reason: str) -> None:
    energised(page)
    page.fill("#tool-place", place)
    page.click("#tool-go")
    expect(page.locator("#tool-problem")).to_contain_text(reason)
    expect(page.locator("#message")).to_be_hidden()


def test_why_the_tool_is_not_led_stands_beside_the_button(page: Page, stand: Stand) -> None:
    energised(page)
    with Client(stand.socket) as client:
        before = [joint["position_rad"] for joint in client.call("status")["joints"]]
        client.call("move", joints_rad=[math.radians(145.0), *before[1:]], duration_s=6.0)
        page.hover("[data-jog=right]")
        page.mouse.down()
        expect(page.locator("#tool-problem")).to_contain_text("base stands at its limit, 145.0 deg")
        page.mouse.up()
        client.call("move", joints_rad=before, duration_s=6.0)


CAMERA = """async () => {
  const { page: { view: { camera } } } = await import("/page.js");
  camera.updateMatrixWorld();
  return [camera.projectionMatrix.elements, camera.matrixWorldInverse.elements, camera.position.toArray()];
}"""


def seen(page: Page, stand: Stand) -> tuple[float, list[float]]:
    """How far from the middle of the picture the true arm comes, its edge being 1, and where the page looks from."""
    projection, to_eye, eye = page.evaluate(CAMERA)
    chain = robots.of(load_arm("ax12-line")).chain
    points = link_points(chain, np.array(stand.simulator.state()["joints_rad"][: chain.n]))
    # Matrices stand column by column.
    clip = (
        np.column_stack([points, np.ones(len(points))])
        @ np.array(to_eye).reshape(4, 4)
        @ np.array(projection).reshape(4, 4)
    )
    return float(np.abs(clip[:, :2] / clip[:, 3:]).max()), eye


def test_the_whole_arm_is_in_the_picture_until_somebody_turns_it(page: Page, stand: Stand) -> None:
    energised(page)
    with Client(stand.socket) as client:

        def stretch(base_deg: float) -> tuple[float, list[float]]:
            q = map(math.radians, (base_deg, 60.0, -20.0, 0.0, 0.0, 0.0))
            client.call("move", joints_rad=list(q), duration_s=5.0)
            stand.ticks(0.3)
            return seen(page, stand)

        assert stretch(50.0)[0] < 1.0
        page.locator("#scene").hover()
        page.mouse.wheel(0.0, -1000.0)
        page.wait_for_function("async () => (await import('/page.js')).page.view.turned")
        near = seen(page, stand)[1]
        assert stretch(-40.0)[1] == near
    page.set_viewport_size({"width": 390, "height": 844})
    page.click("#look")
    farthest, eye = seen(page, stand)
    assert farthest < 1.0
    assert eye != near


def test_a_click_in_the_picture_writes_the_place_under_it(page: Page) -> None:
    energised(page)
    page.fill("#tool-place", "180, 0, 120")
    page.click("#tool-pick")
    page.click("#scene", position={"x": 250, "y": 250})
    expect(page.locator("#tool-place")).to_have_value(re.compile(r"^-?\d+, -?\d+, 120$"))
    expect(page.locator("#tool-place")).not_to_have_value("180, 0, 120")
    page.click("#tool-pick")
    expect(page.locator("#pick-hint")).to_be_hidden()


def rise_m(stand: Stand, since_ns: int) -> float:
    """How far the true tool has risen since then [m]."""
    height_m = stand.simulator.truth(since_ns, time.monotonic_ns()).tool_m[:, 2]
    return float(height_m[-1] - height_m[0])


@pytest.mark.parametrize("ending", ["the button is let go", "the page is gone"])
def test_the_tool_is_led_for_as_long_as_somebody_holds_the_button(page: Page, stand: Stand, ending: str) -> None:
    energised(page)
    with Client(stand.socket) as client:
        client.call("move", point_m=(0.18, 0.0, 0.12))  # not from wherever the tests before have left it
    begin_ns = time.monotonic_ns()
    page.hover("[data-jog=up]")
    page.mouse.down()
    with Client(stand.socket) as client, Client(stand.socket) as asking:
        snapshots = client.subscribe()
        jogged = False
        while rise_m(stand, begin_ns) < 0.001:
            now = next(snapshots)["state"]
            jogged = jogged or now == "jogging"
            if jogged and now == "holding":
                # A machine too slow to say how fast in time for the next tick has ended it: it is begun again.
                page.mouse.up()
                page.mouse.down()
                jogged = False
        if ending == "the page is gone":
            page.close()
        else:
            page.mouse.up()
        # Asked, for the snapshots may lag behind: one of them may tell of the time before the jog.
        while asking.call("status")["state"] != "holding":
            next(snapshots)
    held_ns = time.monotonic_ns()
    stand.ticks(1.0)
    after_m = stand.simulator.truth(held_ns, time.monotonic_ns()).tool_m
    assert abs(after_m - after_m[-1]).max() < 0.003


def test_a_refusal_is_shown_in_the_daemons_words(page: Page) -> None:
    page.click("nav [data-view=guide]")
    expect(page.locator("#takes li")).not_to_have_count(0)
    page.fill("#line-form [name=from]", "0.9, 0, 0.1")
    page.click("#optimise-form [type=submit]")
    expect(page.locator("#optimise-problem")).to_contain_text("BAD_RECORDINGS")


def test_a_fault_is_a_card_and_is_cleared_from_the_page(page: Page, stand: Stand) -> None:
    fault = stand.simulator.fault_begin("dead_bus")
    expect(page.locator("#fault")).to_be_visible()
    expect(page.locator("#faults h2").first).to_have_text(re.compile("BUS_DEAD|SERVO_SILENT"))
    expect(page.locator("#faults article").first).to_contain_text("press “Clear the fault”")
    stand.simulator.fault_end(fault)
    stand.ticks(0.5)
    page.click("#fault [data-command=clear]")
    expect(page.locator("#fault")).to_be_hidden()


def test_release_asks_first(page: Page) -> None:
    state(page, "holding", "off")
    page.click("#release")
    page.click("#confirm [value=no]")
    state(page, "holding", "off")
    page.click("#release")
    page.click("#confirm-yes")
    state(page, "off")


def test_stop_is_served_while_a_question_is_open(page: Page) -> None:
    state(page, "holding", "off")
    page.click("#release")
    expect(page.locator("#confirm")).to_be_visible()
    with page.expect_response(lambda response: response.url.endswith("/api/stop")) as answered:
        page.click("#stop")
    assert answered.value.status == 200
    with page.expect_response(lambda response: response.url.endswith("/api/stop")):
        page.keyboard.press("Escape")
    expect(page.locator("#confirm")).to_be_hidden()
    state(page, "holding", "off")


def test_charts_take_the_colours_of_the_page_when_it_turns_dark(page: Page) -> None:
    page.click("nav [data-view=logs]")
    expect(page.locator("#log-plot .names li")).to_have_count(6)
    plot = page.locator("#log-plot")
    light = plot.get_attribute("data-ink")
    assert light
    page.emulate_media(color_scheme="dark")
    expect(plot).not_to_have_attribute("data-ink", light)


def test_nothing_is_compared_until_something_is_chosen(page: Page) -> None:
    page.click("nav [data-view=compare]")
    expect(page.locator("#compare-hint")).to_be_visible()
    expect(page.locator("#compare-plots")).to_be_hidden()


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_every_view_fits_names_its_controls_and_keeps_stop_in_sight(
    browser: Browser, stand: Stand, scheme: Any, width: int
) -> None:
    context = browser.new_context(viewport={"width": width, "height": 844}, color_scheme=scheme)
    page = context.new_page()
    page.goto(stand.address)
    expect(page.locator("#tick")).not_to_have_text("–", timeout=PATIENCE_MS)
    for view in ("arm", "live", "guide", "program", "compare", "logs", "setup"):
        page.click(f"nav [data-view={view}]")
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), f"{view} is too wide"
        cut = page.evaluate(
            "[...document.querySelectorAll('.wide')].filter(e => e.scrollWidth > e.clientWidth).map(e => e.outerHTML)"
        )
        assert cut == [], f"a table of {view} is cut off"
        page.mouse.wheel(0, 5000)
        box = page.locator("#stop").bounding_box()
        assert box is not None
        assert 0 <= box["y"] <= 844 - box["height"]
        nameless = page.evaluate(
            "[...document.querySelectorAll('button, input, select, textarea')].filter(e => e.checkVisibility() &&"
            " !(e.textContent.trim() || e.labels && e.labels.length || e.ariaLabel)).map(e => e.outerHTML)"
        )
        assert nameless == []
    context.close()


def test_stop_is_reached_by_the_keyboard_alone(page: Page) -> None:
    for _ in range(12):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.id") == "stop":
            break
    assert page.evaluate("document.activeElement.id") == "stop"
    with page.expect_response(lambda response: response.url.endswith("/api/stop")) as answered:
        page.keyboard.press("Enter")
    assert answered.value.status == 200


def ask(stand: Stand, method: str, path: str, **headers: str) -> int:
    """Status of the server's answer, which is JSON."""
    sent = {"X-Armctl-Token": stand.token, "Content-Type": "application/json", **headers}
    body = b"{}" if method == "POST" else None
    address = f"http://127.0.0.1:{stand.port}{path}"
    answer = httpx.request(method, address, content=body, headers=sent, timeout=30.0, trust_env=False)
    answer.json()
    return answer.status_code


def test_foreign_origins_and_wrong_hosts_are_refused_by_the_running_server(stand: Stand) -> None:
    assert ask(stand, "POST", "/api/stop") == 200
    assert ask(stand, "POST", "/api/stop", Origin="http://evil.example") == 403
    assert ask(stand, "POST", "/api/stop", Host="evil.example") == 421
    assert ask(stand, "POST", "/api/stop", **{"X-Armctl-Token": "guess"}) == 401
    assert ask(stand, "POST", "/api/stop", **{"Content-Type": "text/plain"}) == 415


def test_a_page_of_another_origin_gets_nothing(browser: Browser, stand: Stand) -> None:
    page = browser.new_page()
    page.goto("data:text/html,<title>elsewhere</title>")
    outcome = page.evaluate(
        """async ([port, token]) => {
          const fetched = await fetch(`http://127.0.0.1:${port}/api/status`, {headers: {'X-Armctl-Token': token}})
            .then(() => 'served', () => 'refused');
          const socket = await new Promise((resolve) => {
            const opened = new WebSocket(`ws://127.0.0.1:${port}/api/stream`);
            opened.onopen = () => resolve('served'); opened.onclose = () => resolve('refused');
          });
          return [fetched, socket];
        }""",
        [stand.port, stand.token],
    )
    assert outcome == ["refused", "refused"]
    page.close()
