"""The proof of the dashboard: its judge sees what it is there for, and a few connections are lost."""

import shutil

import numpy as np
import pytest

from proving import load, page

LINE = ("0.2, -0.1, 0.1", "0.2, 0.1, 0.1")
GOOD = {"arm": "a", "size": "desk", "clicks": 25, "own_mean_mm": 1.4, "errors": []}
CLICKED = {"stops": 200, "ms_p99": 100.0, "latched": 0}
CUT = {"way": "silent", "stopped_s": 0.2, "went_m": 0.01}


@pytest.mark.parametrize(("journey", "cut", "clicked", "says"), [
    ({"clicks": 26}, {}, {}, "26 clicks"),
    ({"own_mean_mm": 1.6}, {}, {}, "1.6 mm off"),
    ({"own_mean_mm": float("nan")}, {}, {}, "nan mm off"),
    ({"errors": ["x is null"]}, {}, {}, "the page failed: x is null"),
    ({}, {"stopped_s": 0.21}, {}, "moved for 0.21 s"),
    ({}, {"way": "closed", "stopped_s": 0.201}, {}, "moved for 0.201 s"),
    ({}, {"went_m": 0.0}, {}, "did not move before"),
    ({}, {}, {"ms_p99": 100.1}, "within 100.1 ms"),
    ({}, {}, {"ms_p99": float("nan")}, "within nan ms"),
    ({}, {}, {"stops": 199}, "clicked 199 times"),
    ({}, {}, {"latched": 1}, "1 faults latched"),
    ({}, {}, {"latched": float("nan")}, "nan faults latched"),
])  # fmt: skip
def test_what_is_beyond_its_bound_is_told(
    journey: dict[str, object], cut: dict[str, object], clicked: dict[str, object], says: str
) -> None:
    assert page.judged([GOOD], [CUT], CLICKED) == []
    [told] = page.judged([GOOD | journey], [CUT | cut], CLICKED | clicked)
    assert says in told


@pytest.mark.pty
@pytest.mark.crowd
def test_stop_is_clicked_under_a_small_load() -> None:
    """How soon it is served means little on a machine that runs tests; that clicks are counted and answered does."""
    if shutil.which("chromium") is None:
        pytest.skip("no Chromium")
    result = load.prove(1, 4.0, 80.0, stalled=2, hogs=1, crowd={"half_sent": 3}, more={"clicked": page.stop_clicked})
    [clicked] = result["more"]
    assert clicked["stops"] >= 2
    assert 0.0 < clicked["ms_p50"] <= clicked["ms_max"] < 5000.0


def test_a_tool_is_off_its_own_line_and_off_the_wanted_one() -> None:
    y_m = np.linspace(-0.1, 0.1, 201)
    bent = np.stack([np.full(201, 0.203), y_m, 0.1 + 0.002 * (abs(y_m) < 0.05)], axis=1)
    own, wanted = page.off_line_mm(bent, LINE)
    assert own == pytest.approx((1.0, 1.0), abs=0.02)
    assert wanted == pytest.approx((3.3, 3.6), abs=0.1)


def test_a_tool_goes_on_until_it_was_last_seen_to_move() -> None:
    time_ns = np.arange(200) * 10_000_000
    tool_m = np.stack([np.minimum(time_ns / 1e9, 1.15) * 0.03, 0.0 * time_ns, 0.0 * time_ns], axis=1)
    told = page.stood(time_ns, tool_m, 1_000_000_000)
    assert told["stopped_s"] == pytest.approx(0.15, abs=0.02)
    assert told["went_m"] == pytest.approx(0.03, abs=0.001)
    assert page.stood(time_ns, 0.0 * tool_m, 1_000_000_000) == {"stopped_s": 0.0, "went_m": 0.0}


@pytest.mark.pty
@pytest.mark.crowd
def test_connections_are_lost_while_the_tool_is_led() -> None:
    """How soon it stands means little on a machine that runs tests; that it was led before, and stands, does."""
    lost = page.cut_off(1, 2)
    assert [row["way"] for row in lost] == ["silent", "closed"]
    assert all(row["went_m"] > page.LEAST_WAY_M for row in lost)
    assert all(row["stopped_s"] < 0.9 for row in lost)
