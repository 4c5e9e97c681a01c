"""The page shows the arm that the daemon drives, whichever that is, and no other."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from playwright.sync_api import Page, expect, sync_playwright

from armctl.commissioning.arm_file import whole_text
from armctl.lab.demo import started
from proving.dashboard import pages
from tests.web.test_dashboard import CHROMIUM, FLAGS, PATIENCE_MS, pytestmark

__all__ = ["pytestmark"]


@pytest.fixture
def early(tmp_path: Path) -> Iterator[Page]:
    """A page that is opened before there is a daemon."""
    config = tmp_path / "armctl.yaml"
    config.write_text(yaml.safe_dump({"data_dir": str(tmp_path)}))
    common = ("--config", str(config), "--socket", str(tmp_path / "daemon.sock"))
    with (
        pages(tmp_path / "web.log", *common, own=tmp_path / "own") as (_, port, token),
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page()
        page.set_default_timeout(PATIENCE_MS)
        expect.set_options(timeout=PATIENCE_MS)
        page.goto(f"http://127.0.0.1:{port}/#token={token}")
        yield page
        browser.close()


def test_the_page_follows_the_daemon_from_arm_to_arm_and_says_so_where_it_cannot(early: Page, tmp_path: Path) -> None:
    servos, unknown = tmp_path / "servos", tmp_path / "elsewhere" / "nobodys.yaml"
    common = ("--config", str(tmp_path / "armctl.yaml"), "--socket", str(tmp_path / "daemon.sock"))
    unknown.parent.mkdir()
    unknown.write_text(whole_text("lanzhou-4dof").replace("arm_id: lanzhou-4dof", "arm_id: nobodys"))
    expect(early.locator("#arm-id")).to_have_text("ax12-line")
    for arm, joints in (("crane-plus-v2", 5), (str(unknown), 0), ("lanzhou-4dof", 4)):
        with (
            started(tmp_path / "simulator.log", "sim", "--arm", arm, "--link", str(servos)),
            started(tmp_path / "daemon.log", "daemon", "--arm", arm, "--port", str(servos), *common),
        ):
            if joints:
                expect(early.locator("#arm-id")).to_have_text(arm)
            else:
                expect(early.locator("#scene")).to_contain_text("the daemon drives arm nobodys")
            expect(early.locator("#joints tbody tr")).to_have_count(joints)
            expect(early.locator("#state")).to_have_text("off")
