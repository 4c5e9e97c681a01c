"""Every field of every view says beside it, in words, what is wrong with it."""

import math
from collections.abc import Callable, Iterator

import pytest
import yaml
from playwright.sync_api import Page, expect, sync_playwright

from armctl.lab.demo import started
from proving.dashboard import pages
from tests.web.test_dashboard import CHROMIUM, PATIENCE_MS, pytestmark

__all__ = ["pytestmark"]

VIEWS = ("arm", "live", "guide", "program", "compare", "logs", "setup")
NONSENSE = [
    "", " ", "x", "1, 2", "1, 2, 3, 4", "1,,2", "1e999", "-7", "2.5", "99999", "<b>", "nan, 0, 0", "..", "a b", "a/b",
    "0.1, 0.1, 99999", "0x10, 0, 0.1, ", "ü", "-", "5 s", "1e9", "\U0001f9be", "x" * 5000,
]  # fmt: skip


@pytest.fixture(scope="module")
def unserved(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A page whose arm no daemon controls, in a browser that draws nothing in 3D: fields need neither."""
    folder = tmp_path_factory.mktemp("fields")
    servos, config = folder / "servos", folder / "armctl.yaml"
    config.write_text(yaml.safe_dump({"port": str(servos), "data_dir": str(folder)}))
    (folder / "logs").mkdir()
    common = ("--config", str(config), "--socket", str(folder / "daemon.sock"))
    with (
        started(folder / "simulator.log", "sim", "--link", str(servos)),
        pages(folder / "web.log", *common, own=folder / "own") as (_, port, token),
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-3d-apis"])
        page = browser.new_page()
        page.set_default_timeout(PATIENCE_MS)
        expect.set_options(timeout=PATIENCE_MS)
        page.goto(f"http://127.0.0.1:{port}/#token={token}")
        expect(page.locator("#arm-id")).to_have_text("ax12-line")
        yield page
        browser.close()


def place(farthest: float) -> Callable[[str], bool]:
    def fits(value: str) -> bool:
        try:
            numbers = [float(part) for part in value.split(",")]
        except ValueError:
            return False
        return len(numbers) == 3 and all(math.isfinite(one) and abs(one) <= farthest for one in numbers)

    return fits


def number(low: float, high: float, whole: bool = True) -> Callable[[str], bool]:
    def fits(value: str) -> bool:
        try:
            found = float(value)
        except ValueError:
            return False
        return low <= found <= high and (not whole or found == round(found))

    return fits


def name(value: str) -> bool:
    fits = value.isascii() and len(value) <= 64 and value[:1].isalnum()
    return fits and all(one.isalnum() or one in "._-" for one in value)


# What may stand in each field, by its id or name; None: what is wrong with it only the server knows.
FIELDS: dict[str, Callable[[str], bool] | None] = {
    "tool-place": place(10_000), "from": place(10), "to": place(10), "take-name": name, "via": number(0, 20),
    "duration_s": number(0.5, 600, whole=False), "bend-place": place(10_000), "refine-most": number(1, 20),
    "log-words": None, "setup-word": name, "program-name": name,
}  # fmt: skip
# Of each value what the field made of it, what is told, and whether that is seen in the field's own card.
WRITE = """(field, values) => values.map((value) => {
  field.value = value;
  field.dispatchEvent(new Event("input", { bubbles: true }));
  const told = document.getElementById(field.getAttribute("aria-describedby") ?? "none");
  return [field.value, told && !told.hidden ? told.textContent : "",
          Boolean(told) && told.checkVisibility() && field.closest(".card").contains(told)];
})"""


def test_every_field_says_in_words_beside_it_what_is_wrong(unserved: Page) -> None:
    page = unserved
    seen = set()
    for view in VIEWS:
        page.click(f"nav [data-view={view}]")
        if view == "setup":
            page.click("#setup-go")
            page.click("#setup-choices button")
            expect(page.locator("#setup-word")).to_be_visible()
        page.evaluate("document.getElementById('bend-form').hidden = false")
        for field in page.locator(f"#view-{view} input:not([type=range], [type=checkbox], [type=file])").all():
            key = field.evaluate("field => field.id || field.name")
            seen.add(key)
            judge = FIELDS[key]
            if judge is None:
                continue
            for kept, told, beside in field.evaluate(WRITE, NONSENSE):
                fits = judge(kept.strip())
                assert (told == "") == fits, f"{key}: {kept!r} is told {told!r}"
                assert fits or (beside and len(told.split()) > 4), f"{key}: {told!r} is not seen beside it"
                assert len(told) < 200, f"{key}: all that was written is told again"
        if view == "setup":
            page.click("#setup-leave")
            expect(page.locator("#setup-busy")).to_contain_text("interrupted")
    assert seen == set(FIELDS)


@pytest.mark.parametrize(("asked", "view", "step"), [("&view=guide", "guide", "teach"), ("&view=nothing", "arm", "")])
def test_an_address_may_lead_to_a_view_and_a_line(unserved: Page, asked: str, view: str, step: str) -> None:
    """As that of `armctl try` does; the step that comes next is marked."""
    assert unserved.context.browser is not None
    page = unserved.context.browser.new_page()
    token = unserved.evaluate("sessionStorage.getItem('armctl-token')")
    address = unserved.url.partition("#")[0]
    page.goto(f"{address}#token={token}&from=0.2,-0.1,0.2&to=0.2,0.1,0.2{asked}")
    expect(page.locator("#arm-id")).to_have_text("ax12-line")
    expect(page.locator(f"#view-{view}")).to_be_visible()
    expect(page.locator("#line-form [name=from]")).to_have_value("0.2,-0.1,0.2")
    if step:
        expect(page.locator(".steps > [aria-current=step]")).to_have_id(f"step-{step}")
    page.close()


@pytest.mark.parametrize("words", ["servo:x", "load>", "after:yesterday", "level:loud"])
def test_words_that_find_nothing_for_they_mean_nothing_are_refused_beside_them(unserved: Page, words: str) -> None:
    page = unserved
    page.click("nav [data-view=logs]")
    page.fill("#log-words", words)
    page.press("#log-words", "Enter")
    expect(page.locator("#log-words-problem")).to_contain_text("cannot be understood")
    expect(page.locator("#message")).to_be_hidden()


@pytest.mark.parametrize("written", ["nonsense", "\U0001f9be", "x" * 5000])
def test_a_token_that_opens_nothing_is_told_beside_its_field_alone(unserved: Page, written: str) -> None:
    assert unserved.context.browser is not None
    page = unserved.context.browser.new_page()
    page.goto(unserved.url.partition("#")[0])
    page.fill("#login-token", written)
    page.click("#login [type=submit]")
    expect(page.locator("#login-token-problem")).to_contain_text("this token opens nothing")
    expect(page.locator("#message")).to_be_hidden()
    expect(page.locator("#view-arm")).to_be_hidden()
    page.close()


def test_nothing_moves_an_arm_that_no_daemon_controls(unserved: Page) -> None:
    page = unserved
    page.click("nav [data-view=arm]")
    for control in page.locator("#tool-go, [data-jog], #joints input, #go").all():
        expect(control).to_be_disabled()
