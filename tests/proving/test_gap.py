"""The proof of the optimality gap teaches its sets through the whole stack, and finds none that is missed."""

from proving import gap


def test_two_sets_are_within_the_bound() -> None:
    result = gap.prove(seed=3, tell=lambda _: None, sets=2, sizes=(3, 4))
    assert result["runs"] == 4
    assert [row["recordings"] for row in result["rows"]] == [3, 4]
    for row in result["rows"]:
        assert row["gap_mean"] + 1e-12 >= 0.0
        assert row["gap_worst"] <= gap.GAP_BOUND
        assert row["over_bound"] == 0
        assert row["compute_s_worst"] > 0.0
