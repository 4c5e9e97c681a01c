"""Programs and recordings that the page runs, and what who may only look is offered: a real Chromium, a real daemon."""

import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import yaml
from playwright.sync_api import Browser, Page, expect

from armctl.client import Client
from armctl.files import load_arm
from armctl.web.tokens import add
from proving.rig import hold
from tests.host.doubles import refused
from tests.web.test_dashboard import PATIENCE_MS, Stand, energised, pytestmark, state
from tests.web.test_dashboard import browser as browser
from tests.web.test_dashboard import page as page
from tests.web.test_dashboard import stand as stand
from tests.web.test_page_fields import VIEWS

__all__ = ["pytestmark"]

# What moves nothing and changes nothing may be used by all.
LOOKS = "#look, #view-logs *, #view-compare [type=checkbox]"
ROLL = len(load_arm("ax12-line").joints) - 1
TABLE = "x_m,y_m,z_m,kind\n0.23,0,0.1,line\n0.2,0.03,0.1,through\n0.17,0,0.1,arc\n"


def rolled(q: list[float], deg: float) -> list[float]:
    """The same pose, with the roll elsewhere."""
    return [*q[:ROLL], math.radians(deg)]


def test_a_program_is_made_checked_run_stopped_and_goes_on(page: Page, stand: Stand) -> None:
    energised(page)
    page.click("nav [data-view=program]")
    page.fill("#program-name", "to-and-fro")
    page.fill("#program-text", "")
    page.click("#program-here")
    [here] = yaml.safe_load(page.input_value("#program-text"))["steps"]
    with Client(stand.socket) as client:
        told = [joint["position_rad"] for joint in client.call("status")["joints"]]
    q = here["move"]["joints_rad"]
    assert max(abs(a - b) for a, b in zip(q, told, strict=True)) < 0.02
    steps = [{"name": name, "move": {"joints_rad": rolled(q, deg)}} for name, deg in (("to", 40.0), ("fro", -40.0))]
    page.fill("#program-text", yaml.safe_dump({"steps": [*steps, {"wait_s": 0.5}]}))
    page.click("#program-check")
    expect(page.locator("#program-figures")).to_have_text("all 3 steps can be done.")
    expect(page.locator("#program-steps .done")).to_have_count(3)
    page.click("#program-run")
    expect(page.locator("#program-steps [aria-current=step]")).to_contain_text("fro")
    page.click("#stop")
    expect(page.locator("#program-figures")).to_contain_text("A run goes on at step fro.")
    expect(page.locator("#program-steps .wrong")).to_contain_text("fro")
    state(page, "holding")
    page.reload()  # what was written is kept
    page.click("nav [data-view=program]")
    page.fill("#program-name", "to-and-fro")
    page.click("#program-run")
    expect(page.locator("#program-figures")).to_contain_text("2 steps done")
    assert abs(math.degrees(stand.simulator.state()["joints_rad"][ROLL]) + 40.0) < 2.0


WRONG = (
    ("", "steps: Field required"), ("steps: [7]", "step 1"), ("steps: [", "the program"),
    ("steps: [{dance: 1}]", "dance"), ("# " + "x" * 70_000, "a body is at most"),
    ("steps:" + f"\n- path: {{points_m: [{','.join(['[0,0,1],[0,1,1]'] * 250)}]}}" * 10, "make two of it"),
)  # fmt: skip


def test_what_is_wrong_with_a_program_is_told_beside_it(page: Page, stand: Stand) -> None:
    energised(page)
    page.click("nav [data-view=program]")
    for text, reason in WRONG:
        page.fill("#program-text", text)
        page.click("#program-check")
        expect(page.locator("#program-problem")).to_contain_text(reason)
    for step in ("{move: {point_m: [0.9, 0, 0.1]}}", "{play: {name: none}}"):
        page.fill("#program-text", f"steps: [{{wait_s: 1.0}}, {step}]")
        page.click("#program-check")
        expect(page.locator("#program-figures")).to_contain_text("1 of 2 steps cannot be done")
        expect(page.locator("#program-steps .wrong")).to_have_count(1)
        expect(page.locator("#program-problem")).to_be_hidden()
    expect(page.locator("#message")).to_be_hidden()


def test_a_table_of_places_becomes_a_path(page: Page, tmp_path: Path) -> None:
    page.click("nav [data-view=program]")
    waits = "steps:\n- wait_s: 1.0\n"
    page.fill("#program-text", waits)
    file = tmp_path / "arc.csv"
    for table, reason in (
        ("a,b\n1,2\n", "has to name the columns"), ("x_m,y_m,z_m\n1,2\n", "no three numbers: 1,2"),
        ("x_m,y_m,z_m\n1,2,]}\n", "line 2 of the table"),
    ):  # fmt: skip
        file.write_text(table)
        page.set_input_files("#program-file", file)
        expect(page.locator("#program-problem")).to_contain_text(reason)
        expect(page.locator("#program-text")).to_have_value(waits)
    file.write_text(TABLE)
    page.set_input_files("#program-file", file)
    expect(page.locator("#program-text")).not_to_have_value(waits)
    assert yaml.safe_load(page.input_value("#program-text"))["steps"] == [{"wait_s": 1.0}, {"path": {
        "points_m": [[0.23, 0, 0.1], [0.2, 0.03, 0.1], [0.17, 0, 0.1]], "kinds": ["line", "through", "arc"],
    }}]  # fmt: skip


def test_a_recording_is_played_from_its_row(page: Page, stand: Stand) -> None:
    energised(page)
    with Client(stand.socket) as client:
        here = [joint["position_rad"] for joint in client.call("status")["joints"]]
        client.call("move", joints_rad=rolled(here, 15.0), duration_s=2.5)
        recorded = Path(client.call("move", joints_rad=rolled(here, -15.0), duration_s=2.0)["recording"]).name
    page.click("nav [data-view=compare]")
    page.get_by_role("button", name=f"play {recorded}", exact=True).click()
    state(page, "moving")
    expect(page.locator("#play-figures")).to_contain_text("off what was taught on average")
    # What is played is the plan's part of the recording, which ends before the arm has settled.
    assert abs(math.degrees(stand.simulator.state()["joints_rad"][ROLL]) + 15.0) < 5.0
    page.click("nav [data-view=program]")
    page.fill("#program-text", "")
    page.select_option("#program-take", recorded)
    page.click("#program-play")
    expect(page.locator("#program-text")).to_have_value(f"steps:\n- play: {{name: {recorded}}}\n")


def test_who_may_only_look_is_offered_nothing_but_stop(browser: Browser, stand: Stand) -> None:
    _, token = add(stand.socket.with_name("web-tokens.json"), "linus", "look")
    page = browser.new_page()
    expect.set_options(timeout=PATIENCE_MS)
    page.goto(f"{stand.address.partition('#')[0]}#token={token}")
    expect(page.locator("#look-only")).to_be_visible()
    expect(page.locator("#tick")).not_to_have_text("–")
    for view in VIEWS:
        page.click(f"nav [data-view={view}]")
        offered = page.locator(f"#view-{view}").locator("button, input, select, textarea").all()
        usable = [one for one in offered if one.is_visible() and one.is_enabled()]
        assert [one for one in usable if not one.evaluate("(one, all) => one.matches(all)", LOOKS)] == []
    expect(page.locator("#stop")).to_be_enabled()
    with Client(stand.socket) as client:
        hold(client, PATIENCE_MS / 1000)
        here = [joint["position_rad"] for joint in client.call("status")["joints"]]
        snapshots = client.subscribe()
        with Client(stand.socket) as mover, ThreadPoolExecutor(1) as pool:
            moving = pool.submit(mover.call, "move", joints_rad=rolled(here, 60.0), duration_s=20.0)
            next(one for one in snapshots if one["state"] == "moving")
            page.click("#stop")
            with refused("STOPPED"):
                moving.result()
    page.close()
