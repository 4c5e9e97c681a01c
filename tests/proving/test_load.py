"""The load proof's short form, and that its judge would notice."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from proving import crowd, load, rig

FIGURES = yaml.safe_load(Path(__file__).with_name("load.yaml").read_text(encoding="utf-8"))
GOOD: dict[str, Any] = FIGURES["good"]
BAD = [(key, value) for key, values in FIGURES["bad"].items() for value in values]


def test_figures_within_their_bounds_are_in_order() -> None:
    assert load._judge(GOOD, 1000.0) == ([], [])


@pytest.mark.parametrize(("key", "value"), BAD)
def test_each_figure_beyond_its_bound_is_a_violation_and_beside_other_work_those_of_ticks_alone(
    key: str, value: float
) -> None:
    figures = GOOD | {key: value}
    violations, unjudged = load._judge(figures, 1000.0)
    assert (len(violations), unjudged) == (1, [])
    violations, unjudged = load._judge(figures | {"other_work_cores": 0.2}, 1000.0)
    assert len(violations) + len(unjudged) == 1
    assert bool(violations) == (key in ("lateness_ms_max", "skipped_ticks"))


def test_the_work_of_others_is_told_from_ones_own() -> None:
    """What this very process does is its own; that of the machine is at least that."""
    begin_own_s, begin_s = rig._own_s(), rig._machine_s()
    sum(range(5_000_000))
    own_s, machine_s = rig._own_s() - begin_own_s, rig._machine_s() - begin_s
    assert own_s > 0.0
    assert machine_s > own_s - 0.1


@pytest.mark.pty
@pytest.mark.crowd
def test_a_small_load_is_generated_measured_and_told() -> None:
    """What it came to means nothing on a machine that runs tests; that it is counted does."""
    crowds = {"idle": 3, "half_sent": 3, "long_lines": 2, "subscribers": 2}
    told: list[str] = []
    result = load.prove(seed=1, seconds=2.0, rate_hz=80.0, stalled=2, hogs=1, crowd=crowds, tell=told.append)
    assert result["runs"] > 80
    assert result["stops"] + result["moving_stops"] >= 2
    assert result["ticks"] > 5
    assert result["stalled"]["connections"] >= 2
    assert 0.0 < result["status_ms_p50"] <= result["status_ms_p99"] <= result["status_ms_max"]
    assert [row["way"] for row in result["ways"]] == ["lane", "socket", "page", "typed"]
    for row in result["ways"]:
        assert row["stops"] >= 1
        assert 0.0 < row["ms_p50"] <= row["ms_p99"] <= row["ms_max"]
    assert {row["crowd"]: row["connections"] >= row["of"] for row in result["crowds"]} == dict.fromkeys(crowds, True)
    assert next(row["MiB"] for row in result["crowds"] if row["crowd"] == "long_lines") >= 1
    assert any("2 of 2 s" in line or "0 of 2 s" in line for line in told)


@pytest.mark.parametrize(
    ("key", "value"), [("ms_p99", 51.0), ("ms_p99", math.nan), ("ms_max", 101.0), ("ms_max", math.inf)]
)
def test_a_slow_stop_by_any_way_is_a_violation_that_names_it(key: str, value: float) -> None:
    for index, row in enumerate(GOOD["ways"]):
        ways = [{**one, key: value} if one is row else one for one in GOOD["ways"]]
        [found], unjudged = load._judge(GOOD | {"ways": ways}, 1000.0)
        assert unjudged == []
        assert f"by {GOOD['ways'][index]['way']}" in found


def test_long_lines_are_requests_as_long_as_a_line_may_be() -> None:
    for line in crowd.long_lines():
        assert 0.95 * 65536 < len(line) <= 65536
        assert json.loads(line)["method"] == "status"
