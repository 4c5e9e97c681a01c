"""The line bench finds what interpolation alone allows, and the tick floor under it."""

from proving import line_bench


def test_more_points_are_straighter_until_whole_ticks_are_all_that_is_left() -> None:
    result = line_bench.bench(seed=1, lines=1)
    means = {(row["work"], row["who"]): row["value"] for row in result["rows"] if row["unit"] == "mm mean"}
    for who in ("linear, on the line", "cubic, on the line", "linear, placed", "cubic, placed"):
        counts = [via for via in line_bench.VIA if via or "placed" not in who]
        errors = [means[f"straight line, {via} via points", who] for via in counts]
        assert errors == sorted(errors, reverse=True), who
    for via in line_bench.VIA[1:]:
        work = f"straight line, {via} via points"
        assert means[work, "linear, placed"] < means[work, "linear, on the line"]
        assert means[work, "cubic, placed"] <= means[work, "cubic, on the line"] + 1e-9
    floor = means["straight line, any number", "tick floor"]
    assert 0.1 < floor < 1.0
    assert means["straight line, 8 via points", "cubic, placed"] < floor
    assert all(row.keys() == {"work", "who", "value", "unit", "ratio"} for row in result["rows"])
