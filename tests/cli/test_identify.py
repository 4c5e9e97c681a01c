"""`armctl identify` as it is typed; what it finds is judged in tests/proving."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from armctl.cli import identify
from armctl.cli.output import Output
from armctl.files import find_arm_file, load_arm
from armctl.messages import TickRecord
from tests.cli.conftest import Answer, Typed
from tests.recording.factory import ARM, CONTEXT, make_records
from tests.recording.logs import write
from tests.words import missing

pytestmark = pytest.mark.usefixtures("own_folders")


def test_several_logs_stand_behind_one_option(tmp_path: Path, answer: Answer, typed: Typed) -> None:
    logs = [str(write(tmp_path / f"{name}.mcap", make_records(60))) for name in ("a", "b")]
    assert [joint["name"] for joint in answer("identify", "--from-logs", *logs)["joints"]][:2] == ["base", "shoulder"]
    (no_log := tmp_path / "page.html").write_text("no log")
    assert (
        missing(typed("identify", "--from-logs", *logs, str(no_log), status=1).err, "page.html: is no MCAP file") == []
    )


def test_a_word_that_belongs_to_no_option_is_refused(typed: Typed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Output, "follow_daemon", lambda _: None)
    assert missing(typed("identify", "base", status=2).err, "base", "--from-logs or --joints") == []
    assert missing(typed("identify", "--joints", "base", "nobody", status=2).err, "no joint nobody") == []


def test_a_page_takes_the_place_of_a_page_and_of_nothing_else(tmp_path: Path, answer: Answer, typed: Typed) -> None:
    log, page = write(tmp_path / "a.mcap", make_records(60)), tmp_path / "page.html"
    before = log.read_bytes()
    for _ in range(2):
        answer("identify", "--from-logs", log, "--quick", "--report", page)
    said = typed("identify", "--from-logs", log, "--quick", "--report", log, status=2).err
    assert missing(said, "a.mcap", "is no page or picture; choose another name") == []
    assert log.read_bytes() == before


def test_a_log_of_another_arm_makes_no_twin_of_this_one(tmp_path: Path, answer: Answer, typed: Typed) -> None:
    records = make_records(80)
    own = write(tmp_path / "own.mcap", records)
    context = CONTEXT._replace(arm=ARM.model_copy(update={"arm_id": "neighbours"}))
    other = write(tmp_path / "other.mcap", records, context=context)
    spec = Path(answer("identify", "--from-logs", own)["spec"])
    before = spec.read_text()
    for logs in ([other], [own, other]):
        said = typed("identify", "--from-logs", *logs, status=2).err
        assert missing(said, "other.mcap is of another arm than ax12-line", "--config") == []
    assert spec.read_text() == before
    answer("identify", "--from-logs", other, "--quick")  # writes none


def test_a_twin_that_is_renewed_stays_in_its_history_and_nothing_seen_writes_none(
    tmp_path: Path, answer: Answer
) -> None:
    limp = write(tmp_path / "limp.mcap", make_records(60, {}))
    assert answer("identify", "--from-logs", limp)["spec"] is None
    logs = [write(tmp_path / f"{ticks}.mcap", make_records(ticks)) for ticks in (80, 100)]
    spec = Path(answer("identify", "--from-logs", logs[0])["spec"])
    before = spec.read_text()
    answer("identify", "--from-logs", logs[1])
    assert (spec.with_suffix(".history") / "1.json").read_text() == before != spec.read_text()


def test_a_servo_that_never_answered_is_named(tmp_path: Path, typed: Typed) -> None:
    def silent(record: TickRecord) -> TickRecord:
        sample = record.inputs.sample
        servos = list(sample.servos)
        servos[3] = replace(servos[3], fresh=False, registers=b"", stamp_ns=0)
        return replace(record, inputs=replace(record.inputs, sample=replace(sample, servos=tuple(servos))))

    log = write(tmp_path / "a.mcap", map(silent, make_records(20)))
    said = typed("identify", "--from-logs", log, status=1).err
    assert missing(said, "a.mcap: servo 4 (wrist) never answered") == []


def test_a_twin_is_held_against_a_log_in_figures_and_on_a_page(tmp_path: Path, answer: Answer, typed: Typed) -> None:
    log, page = write(tmp_path / "a.mcap", make_records(120, seed=3)), tmp_path / "page.html"
    assert (
        missing(typed("identify", "--compare", log, status=2).err, "twin.json: there is no twin", "armctl identify")
        == []
    )
    spec = Path(answer("identify", "--from-logs", log)["spec"])
    told = answer("identify", "--compare", log, "--report", page)
    assert told["spec"] == str(spec)
    assert [row["name"] for row in told["compared"]] == [joint.name for joint in ARM.joints]
    assert sorted(row["rms_deg"] for row in told["compared"])[4] < 0.3
    assert sorted(row["inside"] for row in told["compared"])[1] > 0.9
    assert 0.0 < told["tool_mean_mm"] < 3.0
    assert missing(page.read_text(encoding="utf-8"), "This arm and its twin", "within the band") == []
    for more in (["--quick"], ["--joints", "base"], ["--from-logs", log]):
        assert "--compare takes one log" in typed("identify", "--compare", log, *more, status=2).err
    # A twin that weighs much more foretells worse; one of three times its weight cannot lift itself.
    twin = json.loads(spec.read_text())
    spec.write_text(json.dumps(twin | {"points_kg": [2.5 * kg for kg in twin["points_kg"]]}))
    assert answer("identify", "--compare", log)["tool_mean_mm"] > 2.0 * told["tool_mean_mm"]
    limp = write(tmp_path / "limp.mcap", make_records(60, {}))
    assert missing(typed("identify", "--compare", limp, status=1).err, "has torque", "no motion") == []


def test_how_ramps_begin_is_kept_with_the_arm() -> None:
    output, shipped = Output(), find_arm_file("ax12-line")
    assert identify._kept(output, ARM, None) is None
    path = identify._kept(output, ARM, False)
    assert path is not None
    known = load_arm("ax12-line")
    assert known.ramp_from_reference is False
    assert known.calibration_hash == ARM.calibration_hash
    assert Path(path).read_text().split("\n")[0] == shipped.read_text().split("\n")[0], "remarks stay"
    assert identify._kept(output, known, False) is None
