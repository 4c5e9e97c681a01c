"""`armctl identify` as it is typed; what it finds is judged in tests/proving."""

from pathlib import Path

from tests.cli.conftest import Answer, Typed
from tests.recording.factory import make_records
from tests.recording.logs import write
from tests.words import missing


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
