"""The proof of identification: two arms for real, and its judgement on made-up outcomes."""

from typing import Any

import pytest

from proving import identify

ROW = {"coulomb_Nm": 0.12, "stiction_ratio": 1.2, "slope_tick": 24.0, "punch": 32.0, "play_deg": 0.4, "delay_ms": 30.0}
SD = {"coulomb_Nm": 0.008, "stiction_ratio": 0.1, "slope_tick": 0.5, "punch": 2.0, "play_deg": 0.04, "delay_ms": 2.0}


def silent(_line: str) -> None:
    pass


def outcome(**changes: Any) -> dict[str, Any]:
    """What was found of one arm, quite rightly."""
    told = {f"{key}_sd": sd for key, sd in SD.items()} | ROW | changes.pop("row", {})
    names = "shoulder", "elbow", "wrist", "hand"
    about = {"true": ROW | {"friction_share": 0.08}, "unseen": {}}
    rows = [{"name": name, **about, **told} for name in names]
    rows += [{"name": name, **about, **told, "play_deg": None} for name in identify.GRAVITY_AXIS]
    ramp = [True, True, True]
    return {"seed": 1, "rows": rows, "ramp": ramp, "took_s": 280.0, "faults": [], "twin_mm": 0.5} | changes


def test_what_is_right_breaks_nothing() -> None:
    assert identify.judged([outcome()])[1] == []


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"row": {"coulomb_Nm": 0.15}}, "coulomb_Nm, axis loaded: 0% of the intervals"),
        ({"row": {"coulomb_Nm_sd": 0.02}}, "coulomb_Nm, axis loaded: 100% of the intervals are wider"),
        ({"row": {"play_deg": 0.55, "play_deg_sd": 0.2}}, "play_deg: 0% are within 0.1"),
        ({"row": {"delay_ms": 44.0}}, "delay_ms: 0% are within 10"),
        ({"row": {"slope_tick": 60.0}}, "slope_tick: 0% are within 1"),
        ({"ramp": [True, False, True]}, "ramp_from_reference False, truly True"),
        ({"ramp": [False, False, None]}, "ramp_from_reference None, truly False"),
        ({"took_s": 301.0}, "took 301 s"),
        ({"faults": ["OVERLOAD"]}, "faults OVERLOAD"),
        ({"twin_mm": 1.2}, "the twin has the tool 1.20 mm off"),
    ],
)
def test_what_is_wrong_is_told(changes: dict[str, Any], text: str) -> None:
    assert any(text in one for one in identify.judged([outcome(**changes)])[1])


def test_play_that_nothing_shows_may_not_be_invented() -> None:
    wrong = outcome()
    wrong["rows"][-1]["play_deg"] = 0.4
    assert "arm 1, roll: the play of a shaft without load was invented" in identify.judged([wrong])[1]


def test_friction_is_told_of_joints_that_bear_a_load() -> None:
    silent_one = outcome()
    for row in silent_one["rows"][-2:]:
        row |= {"coulomb_Nm": None, "unseen": {"coulomb_Nm": "no load shows its strength; 8.3% of that"}}
    assert identify.judged([silent_one])[1] == []
    silent_one["rows"][-1]["unseen"] = {"coulomb_Nm": "no load shows its strength; 9.9% of that"}
    [wrong] = identify.judged([silent_one])[1]
    assert wrong == "friction over strength, said in words: 50% are within 0.15, bound 90%"
    silent_one["rows"][-1]["unseen"] = silent_one["rows"][-2]["unseen"]
    silent_one["rows"][0]["coulomb_Nm"] = None
    assert "coulomb_Nm, axis loaded: was told of 75% of the joints, bound 90%" in identify.judged([silent_one])[1]


def test_arms_with_either_ramp_are_identified() -> None:
    """Two arms cannot tell of shares; what must hold of each one does."""
    found = [identify.trial(identify.Trial(seed, worn=bool(seed % 2), from_reference=seed == 1)) for seed in (1, 2)]
    for one in found:
        wanted, *told = one["ramp"]
        assert told == [wanted, wanted]
        assert one["took_s"] <= identify.MOST_S
        assert one["faults"] == []
        for row in one["rows"]:
            for key, bound in (("delay_ms", 10.0), ("play_deg", 0.15)):
                if row[key] is not None:
                    assert abs(row[key] - row["true"][key]) < bound
                else:
                    assert row["unseen"][key]
            if row["coulomb_Nm"] is not None:
                assert abs(row["coulomb_Nm"] - row["true"]["coulomb_Nm"]) < 3.0 * row["coulomb_Nm_sd"]
    for row in found[0]["rows"]:
        assert row["coulomb_Nm"] is not None or (row["name"] in identify.GRAVITY_AXIS and identify.said_share(row))
    assert found[0]["twin_mm"] < 0.1 * found[0]["off_mm"]
