"""The short form of the proof of clients that end, and that its judge would notice."""

from collections import Counter

import numpy as np
import pytest

from proving import client
from proving.client import Run

TIME_S = np.arange(-0.1, 1.2, 0.01)


def judged(stops_s: float, speed_deg_s: float = 30.0, kept_back_s: float = 0.0) -> Run:
    """One of six joints turns until then."""
    q = np.zeros((len(TIME_S), 6))
    q[:, 0] = np.radians(speed_deg_s * np.minimum(TIME_S, stops_s))
    run = Run("killed", "move", kept_back_s=kept_back_s)
    client.judge(run, q, TIME_S)
    return run


def test_an_arm_that_stands_in_time_is_in_order() -> None:
    run = judged(0.4)
    assert run.violations == []
    assert run.rest_s == pytest.approx(0.38, abs=0.021)
    assert run.speed_deg_s == pytest.approx(30.0, abs=4.0)


def test_an_arm_that_goes_on_too_long_is_noticed_and_one_that_did_not_turn_shows_nothing() -> None:
    assert "moved for" in judged(0.6).violations[0]
    assert judged(0.6, kept_back_s=0.15).violations == []
    assert judged(0.1, speed_deg_s=2.0).still
    assert not judged(0.1).still


def test_every_way_meets_every_motion_as_often() -> None:
    pairs = Counter(zip(client.WAYS * len(client.MOTIONS), client._turned(), strict=True))
    assert set(pairs.values()) == {1}
    assert len(pairs) == len(client.WAYS) * len(client.MOTIONS)
    assert client.RUNS % len(pairs) == 0


@pytest.mark.pty
def test_a_client_that_ends_stops_the_arm_and_one_that_does_not_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    result = client.prove(seed=1, runs=len(client.WAYS))
    # How long things took is judged where nothing else runs.
    assert [told for told in result["examples"] if "moved for" not in told] == []
    assert [one["runs"] for one in result["by_way"]] == [1] * len(client.WAYS)
    monkeypatch.setattr(client, "end", lambda *_: None)
    assert any("moved for" in told for told in client.prove(seed=1, runs=1)["examples"])
