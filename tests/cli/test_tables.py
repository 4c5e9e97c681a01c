"""Every table of the command line, with wide figures and long words, on 80 columns."""

import io
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from armctl.cli import calibrate, demo, experiment, jobs, log, logs, reproduce, servo, setup, study
from armctl.cli.output import Output
from armctl.cli.screen import Screen
from armctl.cli.tables import show_rows, show_table
from armctl.commissioning.calibration import Fit
from armctl.commissioning.doctor import Check
from armctl.commissioning.eeprom import Difference
from armctl.commissioning.scan import FoundServo
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.lab.study.limits import EFFECTS
from armctl.papers.comparison import PaperReport, Row
from armctl.papers.entries import Entry
from armctl.recording import timeline
from armctl.recording.player import Player
from tests.cli.conftest import Typed
from tests.recording.factory import make_records
from tests.recording.logs import write as write_log

COLUMNS = 80
FIGURE = re.compile(r"-?\d+\.\d+(?:e[-+]\d+)?|-?\d+")
WIDEST: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("widest.yaml").read_text(encoding="utf-8"))
LONGEST_NAME = WIDEST["recordings"]["recordings"][0]["name"]


class Tables(Output):
    """Prints tables alone: sentences are left to the terminal to wrap, so that a command in one can be copied."""

    def say(self, text: str) -> None:
        pass


def printed(show: Callable[[Output], object], width: int = COLUMNS) -> str:
    """The tables that a person sees on a terminal of so many columns."""
    output, screen = Tables(), io.StringIO()
    output.console = Screen(file=screen, columns=width)
    show(output)
    return screen.getvalue()


def assert_whole(show: Callable[[Output], object]) -> str:
    """It fits, nothing is cut off, and every figure that a wide screen shows stands here too, unbroken."""
    text = printed(show)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= COLUMNS, text
    assert "…" not in text
    assert sorted(FIGURE.findall(text)) == sorted(FIGURE.findall(printed(show, 1000))), text
    return text


def show_rows_of(output: Output, name: str) -> None:
    show_rows(output.console, name, "", WIDEST[f"log {name}"])


TITLE = "a title that is as long as the longest of the five papers' titles, and then some more of it"
ROWS = tuple(Row(**row) for row in WIDEST["paper"])
REPORT = PaperReport(paper="004", title=TITLE, notes=(), rows=ROWS, tables=(), pictures=())
PRINTED = ("eqs. (19), (20)", "C1 (a2 C2 + a3 C23)", "S1 (a2 C2 + a3 C23) + ...", "[m]")
ENTRY = Entry("002", PRINTED[0], 1, 2, *PRINTED[1:3], "misprint", "line 1", PRINTED[3], (0.1, 0.0))
SERVOS = [FoundServo(**row) for row in WIDEST["servos"]]
CHECKS = [Check(**row) for row in WIDEST["checks"]]
DIFFERENCES = [Difference(**row) for row in WIDEST["differences"]]
KNOWN: dict[str, Any] = {
    "name": f"{LONGEST_NAME}.zero_tick",
    "before": -1023.5,
    "after": 2046.5,
    "standard_error": 123.45,
    "held": "",
}
LEFT: dict[str, Any] = {
    "before": 0.1234,
    "after": 0.1235,
    "standard_error": None,
    "held": "these points do not tell it from the shoulder's zero",
}
PARAMETERS = [KNOWN | {"unit": "tick"}, LEFT | {"name": "lengths_m.a56", "unit": "m"}]
FIT = Fit(load_arm("ax12-line"), PARAMETERS, [123.4, 5.0], rms_before_mm=123.4, rms_mm=12.3, complete=False)
HELD: dict[str, Any] = {
    "parameters": [{"name": f"robot.dh.16.{'w' * 20}", "value": -1023.512, "sd": 0.0012345, "unit": "deg/m"}]
}
HELD |= {"residuals_mm": [123.4, 5.0], "before_mm": 123.4, "held_out_mm": 12.3}
STUDIES = {name: WIDEST[f"study {name}"] for name in ("arms", "ga", "pareto", "paper")}
STUDIES["limits"] = {"rows": [{**WIDEST["study limits"], "without": effect} for effect in (None, *EFFECTS, "timing")]}
TABLES: dict[str, Callable[[Output], object]] = {
    "demo": lambda out: demo.show(out, WIDEST["demo"]),
    "experiment": lambda out: experiment.show(out, WIDEST["experiment"]),
    **{f"study {name}": partial(study.show, name=name, result=result) for name, result in STUDIES.items()},
    "reproduce": lambda out: reproduce.show(out, [REPORT], [ENTRY], None),
    "recordings": lambda out: jobs.show_list(out, WIDEST["recordings"]),
    "optimize": lambda out: jobs.show_optimum(out, WIDEST["optimum"], WIDEST["plan"]),
    "arms": lambda out: show_rows(out.console, "arms", "", WIDEST["arms"]),
    "transfer": lambda out: show_rows(out.console, "transfer", "Peaks", WIDEST["transfer"]),
    "scan": lambda out: setup.show_servos(out, SERVOS),
    "doctor": lambda out: setup.show_checks(out, CHECKS),
    "servo eeprom": lambda out: servo.show_differences(out, DIFFERENCES, "differ"),
    "calibrate": lambda out: calibrate.show_found(out, "limp", FIT._asdict()),
    "calibrate --holding": lambda out: calibrate.show_found(out, "holding", HELD),
    "log info": lambda out: log.show_topics(out, {"/armctl/" + "t" * 80: 1234567890}),
    **{f"log {name}": partial(show_rows_of, name=name) for name in ("logs", "events", "stats", "diff")},
}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_fits_80_columns_with_every_figure_whole(name: str) -> None:
    assert assert_whole(TABLES[name])


def test_all_that_a_demonstration_says_fits_80_columns_with_no_pair_of_figures_broken() -> None:
    usual = {"mean_error_mm": 23.84, "max_error_mm": 41.94}
    told = WIDEST["demo"]
    row = {"mean_error_mm": 33.7, "max_error_mm": 41.9, "duration_s": 5.0, "truth": usual, "own_chord": usual}
    row |= {"predicted_mean_error_mm": 20.94, "predicted_max_error_mm": 39.24}
    rows = [{**row, "via": via, "goals": goals} for goals in ("plain", "corrected", "refined") for via in (0, 1, 2)][:8]
    output, screen = Output(), io.StringIO()
    output.console = Screen(file=screen, columns=COLUMNS)
    demo.show(output, {**told, "rows": rows})
    lines = screen.getvalue().splitlines()
    assert max(len(line) for line in lines) <= COLUMNS, "\n".join(lines)
    pairs = [re.findall(r"\d+\.\d / \d+\.\d", line) for line in lines]
    assert [len(found) for found in pairs if found] == [5] * len(rows)
    assert [line.split()[1] for line in lines if " / " in line][6:] == ["corrected", "refined", "refined"]


def test_the_picture_of_a_replay_fits(tmp_path: Path) -> None:
    log = timeline.load(write_log(tmp_path / "a.mcap", make_records(60, seed=3)))
    player = Player(log.duration_s, at_s=0.5)
    assert_whole(lambda output: output.console.print(*logs.picture(log, player, output.console)))
    narrow = printed(lambda output: output.console.print(*logs.picture(log, player, output.console)), 50)
    assert max(map(len, narrow.splitlines())) <= 50  # or it could not be drawn again in its place


@pytest.mark.parametrize("robot", ["puma560", "transfer-6dof", "ax12-line", "xiang-6dof", "lanzhou-4dof"])
def test_the_kinematics_of_every_robot_fit(robot: str, typed: Typed) -> None:
    joints = robots.get(robot).chain.n
    q = ",".join(["-123.4567891"] * joints)
    one = ("--robot", robot)
    for arguments in (
        ("robots",),
        ("fk", *one, "--q", q, "--deg"),
        ("jacobian", *one, "--q", q, "--deg"),
        ("ik", *one, "--xyz", "0.1,0.1,0.1", "--deg", "--all"),
        ("workspace", *one, "--samples", "100"),
        ("trajectory", *one, "--q0", q, "--q1", ",".join(["100"] * joints), "--duration", "0.1", "--deg"),
    ):
        lines = typed(*arguments).out.splitlines()
        assert max(len(line.rstrip()) for line in lines) <= COLUMNS, "\n".join(lines)
        assert "…" not in "".join(lines)


FIGURES = st.floats(-1e6, 1e6).map(lambda value: f"{value:.3f}")
SENTENCES = st.lists(st.text("abcdefgh[]/", min_size=1, max_size=12), min_size=1, max_size=20).map(" ".join)


@given(rows=st.lists(st.tuples(FIGURES, SENTENCES, FIGURES, SENTENCES), max_size=5))
def test_any_table_fits_and_keeps_its_figures_and_words(rows: list[tuple[str, ...]]) -> None:
    text = assert_whole(lambda out: show_table(out.console, "", ("a", "b", "c", "d"), rows, words=("b", "d")))
    for _, sentence, _, _ in rows:
        assert all(word in text for word in sentence.split())


def test_a_cell_that_does_not_fit_goes_on_below_itself() -> None:
    rows = [("one", "12.5", "two words"), ("x", "1", "a\nb"), ("y" * 9, "2", "")]
    text = printed(lambda out: show_table(out.console, "", ("n", "s", "said"), rows, words=("n", "said")), 18)
    assert text.splitlines() == [
        *("n          s said", "─" * 18, "one     12.5 two", "             words"),
        *("x          1 a b", "yyyyyyy    2", "yy"),
    ]


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "ascii"])
def test_a_table_is_shown_on_a_terminal_of_any_encoding_and_steers_none(encoding: str) -> None:
    screen = io.BytesIO()
    console = Screen(file=io.TextIOWrapper(screen, encoding), columns=COLUMNS)
    show_table(console, "", ("name", "°C"), [("a\x1b[2Jb\nc", "30"), ("Ω", "31")], ("name",))
    console.file.flush()
    shown = screen.getvalue().decode(encoding)
    assert "\x1b" not in shown
    assert [line.split()[-1] for line in shown.splitlines()[-2:]] == ["30", "31"]
    assert "a [2Jb c" in shown
