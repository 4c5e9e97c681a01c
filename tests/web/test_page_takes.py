"""What the page records, and how it runs it: a real Chromium, a real daemon, simulated servos."""

import json
import math
import re
from typing import Any

import pytest
from playwright.sync_api import Page, Route, expect

from armctl.client import Client
from tests.web.test_dashboard import Stand, begin_to_teach, energised, go, pytestmark, state
from tests.web.test_dashboard import browser as browser
from tests.web.test_dashboard import page as page
from tests.web.test_dashboard import stand as stand

__all__ = ["pytestmark"]


def taught(stand: Stand) -> list[str]:
    with Client(stand.socket) as client:
        return [one["name"] for one in client.call("recordings_list")["recordings"]]


@pytest.mark.parametrize("why", ["out of reach", "the hand does nothing", "teaching ends"])
def test_a_take_that_the_hand_did_not_give_is_not_kept(page: Page, stand: Stand, why: str) -> None:
    def idle(route: Route) -> None:
        route.fulfill(body=json.dumps({"duration_s": 0.5 if why == "the hand does nothing" else 3.0}))

    before = taught(stand)
    page.click("nav [data-view=guide]")
    begin_to_teach(page, stand)
    state(page, "teaching")
    if why == "out of reach":
        page.fill("#line-form [name=from]", "0.9, 0, 0.1")
    else:
        page.route("**/api/hand", idle)
    page.click("#take-by-hand")
    if why == "teaching ends":
        expect(page.locator("#take")).to_have_text("End the take")
        page.evaluate("import('/page.js').then(({ post }) => post('/teach/end'))")
        state(page, "off")
    expect(page.locator("#message")).to_contain_text("SIMULATOR" if why == "out of reach" else "the take is not kept")
    expect(page.locator("#take")).to_have_text("Begin a take")
    assert taught(stand) == before
    if why != "teaching ends":
        page.click("#teach-end")
    state(page, "off")


def test_a_motion_runs_at_the_speed_that_was_chosen_also_when_it_is_under_way(page: Page, stand: Stand) -> None:
    energised(page)
    page.locator(".rate").first.fill("50")
    expect(page.locator(".rate-told").last).to_have_text("50 %")
    page.get_by_label("where roll is to be, degrees").fill("40")
    rates: list[float] = []

    def watch() -> None:
        with Client(stand.socket) as client:
            rates[:] = [one["rate"] for one in until_held(client)]

    go(page, watch)
    assert 0.5 in rates
    assert abs(math.degrees(stand.simulator.state()["joints_rad"][-1]) - 40.0) < 2.0


def until_held(client: Client) -> list[dict[str, Any]]:
    """Every snapshot of the motion that begins."""
    seen: list[dict[str, Any]] = []
    for one in client.subscribe():
        if one["state"] == "moving":
            seen.append(one)
        elif seen:
            break
    return seen


def test_whether_goals_are_corrected_is_asked_for_with_the_run(page: Page) -> None:
    def refused(route: Route) -> None:
        asked.append(route.request.post_data_json)
        route.fulfill(status=409, body=json.dumps({"error": {"code": "NO", "reasons": ["not now"]}}))

    asked: list[Any] = []
    plans = {"plans": [{"name": "a", "predicted_mean_error_mm": 1.0}]}
    page.route("**/api/plans", lambda route: route.fulfill(body=json.dumps(plans)))
    page.route(re.compile("/api/plans/a$"), lambda route: route.fulfill(body=json.dumps(PLAN)))
    page.route("**/api/plans/a/run", refused)
    energised(page)
    page.click("nav [data-view=guide]")
    expect(page.locator("#plan-choice")).to_have_value("a")
    page.click("#run")
    expect(page.locator("#message")).to_contain_text("not now")
    page.uncheck("#corrected")
    page.click("#run")
    expect(page.locator("#run-figures")).to_contain_text("the run failed: ")
    assert [one["corrected"] for one in asked] == [True, False]


PLAN = {"name": "a", "plan": {"via": 0, "waypoints_rad": []}, "tool_m": []}
