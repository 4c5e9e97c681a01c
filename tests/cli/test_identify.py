"""`armctl identify` as it is typed; what it finds is judged in tests/proving."""

from dataclasses import replace
from pathlib import Path

import pytest

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


def test_a_word_that_belongs_to_no_option_is_refused(typed: Typed) -> None:
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
