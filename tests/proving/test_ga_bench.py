"""Every library of the bench solves the same problem from the same start, and is measured."""

from proving import ga_bench


def test_every_library_is_measured_on_both_problems_and_none_beats_the_exact_optimum() -> None:
    result = ga_bench.bench(seed=1, generations=10, rounds=1)
    speeds = [row for row in result["rows"] if row["unit"] == "evaluations/s"]
    assert [row["who"] for row in speeds] == ["armctl", "pymoo", "PyGAD", "DEAP"] * 2
    assert all(row["value"] > 0.0 for row in speeds)
    costs = [row for row in result["rows"] if row["unit"] == "mm, least cost"]
    assert len(costs) == 10
    assert all(row["ratio"] >= 1.0 - 1e-9 for row in costs)
    assert [check["bound"] for check in result["checks"]] == [ga_bench.PYMOO_RATIO, ga_bench.DEAP_RATIO, 1.0, 1.0]
    assert all(row.keys() == {"work", "who", "value", "unit", "ratio"} for row in result["rows"])
