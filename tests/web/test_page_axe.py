"""axe-core finds nothing in any view of the page, wide and on a phone, light and dark, and in what comes up there."""

from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.web.test_dashboard import PATIENCE_MS, Stand, acknowledge, pytestmark
from tests.web.test_dashboard import browser as browser
from tests.web.test_dashboard import stand as stand
from tests.web.test_page_fields import VIEWS

__all__ = ["pytestmark"]

AXE = Path(__file__).parent.parent / "recording" / "node" / "node_modules" / "axe-core" / "axe.min.js"
LOOKS = [(1280, "light"), (1280, "dark"), (390, "light"), (390, "dark")]


def wrong(page: Page, where: str) -> list[str]:
    """What axe finds in the page as it is now."""
    page.evaluate(AXE.read_text(encoding="utf-8"))
    told = page.evaluate("axe.run()")["violations"]
    return [f"{where}: {one['id']}: {one['nodes'][0]['html'][:120]}" for one in told]


@pytest.mark.skipif(not AXE.is_file(), reason=f"npm ci has not been run in {AXE.parents[2]}")
@pytest.mark.parametrize(("width", "scheme"), LOOKS)
def test_axe_finds_nothing_in_any_view(browser: Browser, stand: Stand, scheme: Any, width: int) -> None:
    context = browser.new_context(viewport={"width": width, "height": 844}, color_scheme=scheme)
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    expect.set_options(timeout=PATIENCE_MS)
    page.goto(stand.address.partition("#")[0])
    expect(page.locator("#login")).to_be_visible()
    found = wrong(page, "log in")
    page.goto(stand.address)
    page.reload()  # the address alone does not load the page again
    expect(page.locator("#tick")).not_to_have_text("–")
    for view in VIEWS:
        page.click(f"nav [data-view={view}]")
        if view == "setup":
            page.click("#setup-go")
            expect(page.locator("#setup-choices button").first).to_be_visible()
        found += wrong(page, view)
        if view == "setup":
            page.click("#setup-leave")
            expect(page.locator("#setup-go")).to_be_visible()
    page.click("nav [data-view=arm]")
    fault = stand.simulator.fault_begin("mute", servo_id=3)
    expect(page.locator("#fault")).to_be_visible()
    page.fill("#tool-place", "nowhere")
    page.click("#release")
    expect(page.locator("#confirm")).to_be_visible()
    found += wrong(page, "a fault, a question and a refusal")
    stand.simulator.fault_end(fault)
    acknowledge(stand)
    context.close()
    assert found == []
