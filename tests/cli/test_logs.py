"""What people do with log files, at the command line."""

import io
import json
import math
import os
import pty
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from armctl import __version__
from armctl.cli import logs
from armctl.cli.keys import keys
from armctl.cli.output import Output
from armctl.cli.screen import Screen
from armctl.clock import VirtualClock
from armctl.messages import Event
from armctl.recording import index, provenance, reader, timeline
from armctl.recording.player import Player
from tests.cli.conftest import Answer, Typed
from tests.cli.test_screen import Terminal
from tests.recording.factory import CONTEXT, make_records
from tests.recording.logs import of_an_older_build
from tests.recording.logs import write as write_log
from tests.recording.test_player import waiting
from tests.words import missing

RECORDS = make_records(60, seed=3)
REPLAY_KEYS = {"ticks", "messages", "mismatches", "seconds", "realtime_ratio"}
DOCS = Path(logs.__file__).parent.parent / "docs" / "logs.md"


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "a.mcap", RECORDS)


# ------------------------------------------------------------------------------------------------- a folder of them


@pytest.mark.parametrize("words", [("list",), ("find", "code:PLAN_BEGIN")])
def test_a_folder_that_is_known_is_asked_without_what_reads_logs(
    log: Path, words: Sequence[str], answer: Answer, tmp_path: Path
) -> None:
    (tmp_path / log.name).write_bytes(log.read_bytes())
    told = answer("log", *words, "--log-dir", tmp_path)
    asked = "import json, sys; from armctl.cli import main; main(sys.argv[1:]); print(json.dumps([*sys.modules]))"
    command = [sys.executable, "-c", asked, "log", *words, "--log-dir", str(tmp_path), "--json"]
    found, modules = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert json.loads(found) == told
    assert not {"numpy", "pydantic", "mcap", "yaml", "multiprocessing"} & set(json.loads(modules))


def test_an_answer_says_how_many_logs_it_lacks(
    log: Path, answer: Answer, typed: Typed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in "abc":
        (tmp_path / f"{name}.mcap").write_bytes(log.read_bytes())
    monkeypatch.setattr(index, "FEW", 1)
    monkeypatch.setattr(index, "Popen", lambda *_, **__: None)
    where = "--log-dir", tmp_path
    assert "2 older logs are still being read" in typed("log", "list", *where).err
    assert answer("log", "find", "code:PLAN_BEGIN", *where)["unread"] == 1
    assert answer("log", "stats", *where)["unread"] == 0
    told = answer("log", "list", *where)
    assert (len(told["logs"]), told["unread"]) == (3, 0)


# ----------------------------------------------------------------------------------------------------- replay


@pytest.mark.parametrize("check", [(), ("--check",)])
def test_replay_in_json_compares_bit_for_bit(log: Path, check: Sequence[str], answer: Answer) -> None:
    found = answer("replay", log, *check)
    assert found.keys() >= REPLAY_KEYS
    assert (found["ticks"], found["judged"], found["mismatches"]) == (60, 60, 0)
    assert (found["skipped"], found["gaps"], found["first"]) == (0, [], None)


@pytest.fixture
def wrong(tmp_path: Path) -> Path:
    """A log whose tick 30 is not what the daemon would have done."""
    changed = replace(RECORDS[30], outputs=RECORDS[31].outputs)
    return write_log(tmp_path / "a.mcap", [*RECORDS[:30], changed, *RECORDS[31:]])


def test_a_log_that_does_not_repeat_fails_the_check(wrong: Path, answer: Answer) -> None:
    found = answer("replay", wrong, status=1)
    assert found["mismatches"] > 0
    assert found["first_mismatch"].startswith(f"tick 30, {found['first']['field']}: ")


def test_a_log_of_another_version_that_differs_says_so(
    wrong: Path, typed: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = provenance.program()
    monkeypatch.setattr(provenance, "program", lambda: ours | {"version": "99.0"})
    said = typed("replay", wrong, "--check", status=1)
    told = " ".join(said.out.split())
    assert f"made by armctl {__version__}, this is 99.0" in told
    commit = ours["commit"]
    assert told.endswith(f"git checkout {commit}" if commit else f"pip install armctl=={__version__}")
    monkeypatch.undo()
    assert "made by" not in typed("replay", wrong, "--check", status=1).out
    monkeypatch.setattr(provenance, "program", lambda: ours | {"sources": "0123456789abcdef"})
    told = " ".join(typed("replay", wrong, "--check", status=1).out.split())
    assert f"made by other sources of armctl {__version__}" in told


def test_a_log_of_an_older_build_says_in_a_line_what_was_not_compared(
    log: Path, tmp_path: Path, typed: Typed, answer: Answer
) -> None:
    old = of_an_older_build(log, tmp_path / "old.mcap")
    left_out = ["/armctl/writes", "/armctl/cycle"]
    said = " ".join(typed("replay", old, "--check", "--allow-gaps").out.split())
    why = "not compared, since the log's armctl wrote them otherwise or not at all: "
    assert "bit for bit the same" in said
    assert said.endswith(why + ", ".join(left_out))
    assert answer("replay", old, status=1)["not_compared"] == left_out
    assert "not compared" not in typed("replay", log, "--check").out


def test_a_check_that_passed_something_over_fails_unless_that_is_allowed(
    tmp_path: Path, typed: Typed, answer: Answer
) -> None:
    gap = write_log(tmp_path / "gap.mcap", [*RECORDS[:20], *RECORDS[25:]])
    found = answer("replay", gap, status=1)
    assert (found["judged"], found["skipped"], found["mismatches"]) == (20, 35, 0)
    assert [set(one) for one in found["gaps"]] == [{"from_s", "to_s"}]
    assert answer("replay", gap, "--allow-gaps") | {"seconds": 0, "realtime_ratio": 0} == found | {
        "seconds": 0,
        "realtime_ratio": 0,
    }
    said = " ".join(typed("replay", gap, "--check", status=1).out.split())
    assert "what was judged is bit for bit the same" in said
    assert "not judged: 35 ticks" in said
    assert "nothing judged from 1.9 s to 5.9 s" in said


def test_replay_writes_a_report_and_says_where(log: Path, tmp_path: Path, answer: Answer) -> None:
    page = tmp_path / "r.html"
    assert answer("replay", log, "--report", page)["report"] == str(page)
    assert "0 mismatches" in page.read_text()
    answer("replay", log, "--report", log, status=1)  # never over the log
    assert reader.info(log).complete


def watched(log: Path, *, terminal: bool, rate: float = 1.0, start_s: float = 0.0) -> str:
    output, screen, clock = Output(), Terminal() if terminal else io.StringIO(), VirtualClock()
    output.console = Screen(file=screen, columns=120)
    logs._watch(output, timeline.load(log), waiting(clock), clock, rate=rate, start_s=start_s, loop=False)
    return screen.getvalue()


def test_without_a_terminal_there_is_a_line_a_second(log: Path) -> None:
    lines = watched(log, terminal=False).splitlines()
    assert [line.split()[0] for line in lines] == ["0.0", "1.0", "2.0", "3.0", "4.0", "5.0", "5.9"]
    found = timeline.load(log)
    assert [line.split()[2] for line in lines[:6]] == [found.state(found.index(float(second))) for second in range(6)]
    assert len(watched(log, terminal=False, rate=2.0, start_s=2.0).splitlines()) == 3


def test_in_a_terminal_every_joint_and_the_events_are_shown(log: Path) -> None:
    screen = watched(log, terminal=True, rate=5.0)
    assert not missing(screen, *CONTEXT.arm.joint_names, "PLAN_BEGIN: nod", "5.9 of 5.9 s", "space: pause")


def test_what_is_shown_is_what_the_log_says(log: Path) -> None:
    found = timeline.load(log)
    picture = logs.picture(found, Player(found.duration_s, at_s=2.5), Screen(file=io.StringIO(), columns=120))
    frame = found.index(2.5)
    angles = [f"{math.degrees(value):.1f}" for value in found.position_rad[frame]]
    assert not missing("\n".join(picture), found.state(frame), *angles, f"{found.tool[frame, 0] * 1000.0:.1f}")


def test_beginning_beyond_the_end_is_one_clear_sentence(log: Path, typed: Typed) -> None:
    assert "lasts 5.9 s" in typed("replay", log, "--start", "100", status=1).err


def test_keys_of_a_terminal_come_one_by_one_and_by_name() -> None:
    ours, theirs = pty.openpty()
    try:
        with open(theirs, closefd=False) as stream, keys(stream) as pressed:
            for data, name in ((b" ", " "), (b"\x1b[D", "left"), (b"\x1b[C", "right"), (b"q", "q")):
                os.write(ours, data)
                assert pressed.wait(10.0) == name
            assert pressed.wait(0.0) == ""
            os.write(ours, b"\x1b[Cx q")  # pressed while a picture was drawn
            assert [pressed.wait(10.0) for _ in range(4)] == ["right", "x", " ", "q"]
    finally:
        os.close(ours)
        os.close(theirs)


def test_where_there_is_no_terminal_there_are_no_keys(tmp_path: Path) -> None:
    (tmp_path / "x").touch()
    with (tmp_path / "x").open() as stream, keys(stream) as pressed:
        assert pressed.wait(0.0) == ""


def test_a_simulated_arm_repeats_the_log(log: Path, answer: Answer) -> None:
    found = answer("replay", log, "--onto-sim", "--arm", "ax12-line", "--seed", "3")
    assert found["joint_rms_rad"] < 0.01
    assert found["ticks"] == 59


def test_the_log_of_another_arm_is_refused_on_the_simulator(log: Path, tmp_path: Path, answer: Answer) -> None:
    other = tmp_path / "other.yaml"
    text = Path(__file__).parents[2].joinpath("calibration", "ax12-line.yaml").read_text()
    other.write_text(re.sub(r"^arm_id: .*$", "arm_id: other", text, flags=re.MULTILINE))
    assert answer("replay", log, "--onto-sim", "--arm", other, status=1)["error"]["code"] == "FOREIGN_LOG"
    assert answer("replay", log, "--onto-sim", "--arm", other, "--foreign")["ticks"] > 0


# ------------------------------------------------------------------------------------------------------ files


def test_info_tells_what_the_contract_names(log: Path, answer: Answer) -> None:
    found = answer("log", "info", log)
    assert found.keys() >= {"messages", "start_s", "duration_s", "topics", "complete"}
    assert found["topics"]["/joint_states"] == 60


@pytest.mark.parametrize("kind", ["csv", "xlsx", "parquet"])
def test_export_writes_a_file_and_tells_its_rows(log: Path, tmp_path: Path, kind: str, answer: Answer) -> None:
    out = tmp_path / f"t.{kind}"
    found = answer("log", "export", log, "--format", kind, "--out", out)
    assert (found["paths"], found["rows"]["ticks"]) == ([str(out)], 60)
    answer("log", "export", log, "--format", kind, "--out", out, status=1)  # nothing is overwritten


def test_trim_and_merge_tell_what_they_wrote(log: Path, tmp_path: Path, answer: Answer) -> None:
    parts = [tmp_path / "1.mcap", tmp_path / "2.mcap"]
    first = answer("log", "trim", log, "--from", "0", "--to", "2.55", "--out", parts[0])
    answer("log", "trim", log, "--from", "2.55", "--out", parts[1])
    assert (first["path"], first["duration_s"]) == (str(parts[0]), pytest.approx(2.5, abs=0.06))
    merged = answer("log", "merge", *parts, "--out", tmp_path / "3.mcap")
    assert merged["messages"] == reader.info(tmp_path / "3.mcap").messages
    assert answer("replay", tmp_path / "3.mcap", "--check")["mismatches"] == 0
    answer("log", "merge", *parts, "--out", tmp_path / "3.mcap", status=1)


def test_damage_is_told_on_stderr(tmp_path: Path, typed: Typed) -> None:
    part = write_log(tmp_path / "a[bold].mcap", RECORDS[:30], finish=False)  # a name is no markup
    said = typed("log", "export", part, "--format", "csv", "--out", tmp_path / "t.csv")
    assert "a[bold].mcap.part was not closed properly" in said.err


# -------------------------------------------------------------------------------------------------- a folder of them


@pytest.fixture
def logs_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The daemon's folder, with two logs of which one has a fault."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    folder = tmp_path / "armctl" / "logs"
    write_log(folder / "armctl-1.mcap", RECORDS[:20])
    tripped = Event("error", "TRIPPED", "servo 3 (elbow): shut itself down", 3)
    changed = replace(RECORDS[30], outputs=replace(RECORDS[30].outputs, events=(tripped,)))
    write_log(folder / "armctl-2.mcap", [*RECORDS[20:30], changed])
    return folder


def test_a_folder_is_listed_searched_and_noted_as_the_contract_says(
    logs_folder: Path, answer: Answer, typed: Typed
) -> None:
    answer("log", "note", logs_folder / "armctl-1.mcap", "a [new] gripper")
    first, second = answer("log", "list")["logs"]
    listed = {"path", "start", "duration_s", "arm_id", "version", "simulated", "faults", "size_bytes", "complete"}
    assert first.keys() >= listed
    assert (first["path"], first["notes"]) == (str(logs_folder / "armctl-1.mcap"), ["a [new] gripper"])
    assert (first["version"], first["complete"], second["faults"]) == (__version__, True, ["TRIPPED"])
    (event,) = answer("log", "find", "code:TRIPPED", "servo:3")["events"]
    assert event.keys() >= {"log", "time_s", "code", "text"}
    assert (event["log"], event["time_s"]) == (second["path"], pytest.approx(1.0, abs=0.01))
    assert answer("log", "find", "code:NOTHING")["events"] == []
    assert "servo:x: cannot be understood" in typed("log", "find", "servo:x", status=2).err  # and :x: is no picture
    shown = typed("log", "list", "--log-dir", logs_folder).out
    assert not missing(" ".join(shown.split()), "TRIPPED", "a [new] gripper")
    assert "shut itself down" in typed("log", "find", "TRIPPED").out
    typed("log", "list", "--log-dir", logs_folder / "none", status=1)


def test_a_list_says_what_is_wrong_with_a_file(logs_folder: Path, typed: Typed) -> None:
    (logs_folder / "cut.mcap.part").write_bytes((logs_folder / "armctl-1.mcap").read_bytes()[:-5000])
    (logs_folder / "empty.mcap").touch()
    shown = {line.split()[0]: line for line in typed("log", "list").out.splitlines()[2:]}
    assert shown["cut.mcap.part"].endswith("(not ended, or damaged)")
    assert shown["empty.mcap"].endswith("cannot be read: it is empty")
    assert shown["armctl-1.mcap"].endswith(CONTEXT.arm.arm_id)


def test_joints_are_followed_and_two_logs_compared(logs_folder: Path, answer: Answer, typed: Typed) -> None:
    rows = answer("log", "stats", "--by", "month")["rows"]
    assert {row["joint"] for row in rows} == set(CONTEXT.arm.joint_names)
    assert CONTEXT.arm.joint_names[0] in typed("log", "stats").out
    pair = logs_folder / "armctl-1.mcap", logs_folder / "armctl-2.mcap"
    found = {row["quantity"]: row for row in answer("log", "diff", *pair)["rows"]}
    assert all(row.keys() == {"quantity", "a", "b", "difference"} for row in found.values())
    assert found["events, error"]["difference"] == 1
    assert "duration_s" in typed("log", "diff", *pair).out
    page = logs_folder.parent / "diff.html"
    assert answer("log", "diff", *pair, "--report", page)["report"] == str(page)
    assert "Log armctl-1.mcap and armctl-2.mcap" in page.read_text()


# ------------------------------------------------------------------------------------------------------- docs


def examples() -> list[list[str]]:
    """Every armctl command of the page about logs that works on a file alone."""
    blocks = re.findall(r"```sh\n(.*?)```", DOCS.read_text(), re.DOTALL)
    lines = [shlex.split(line, comments=True) for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [words[1:] for words in lines if words[:1] == ["armctl"] and words[1] in ("replay", "log", "live")]


def test_documented_commands_work(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, typed: Typed) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    (tmp_path / "armctl" / "logs").mkdir(parents=True)
    for name in ("lift.mcap", "cut.mcap"):
        Path(name).write_bytes(log.read_bytes())
    found = examples()
    assert len(found) >= 8
    for words in (words for words in found if words[0] != "live" or "--layout" in words):
        fast = ["--rate", "1000"] if words[0] == "replay" and len(words) == 2 else []
        assert "Traceback" not in typed(*words, *fast).err
