"""What a terminal shows of what is drawn on it, by a terminal that nobody here wrote."""

import io
import os
from contextlib import suppress

import pyte
import pytest

from armctl.cli.output import Output
from armctl.cli.screen import REDRAWN_S, Screen, filled

COLUMNS, LINES = 60, 8


class Terminal(io.StringIO):
    """What is written is kept; it says that it is a terminal."""

    encoding = "utf-8"

    def isatty(self) -> bool:
        return True

    def shown(self) -> list[str]:
        """The lines that a person sees."""
        screen = pyte.Screen(COLUMNS, LINES)
        pyte.Stream(screen).feed(self.getvalue().replace("\n", "\r\n"))
        return [line.rstrip() for line in screen.display if line.strip()]


@pytest.fixture(autouse=True)
def _colours(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NO_COLOR", "COLUMNS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")


def test_a_picture_takes_the_place_of_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    screen = Screen(file=terminal)
    monkeypatch.setattr(os, "get_terminal_size", lambda _: os.terminal_size((COLUMNS, LINES)))
    monkeypatch.setattr(terminal, "fileno", lambda: 1)
    screen.print("before")
    for picture in (["one", "two, long", "three"], ["1", "2"], [screen.styled("a", bold=True), "b", "c"]):
        screen.draw(picture)
    assert terminal.shown() == ["before", "a", "b", "c"]
    screen.draw([str(i) for i in range(20)])  # higher than the terminal
    screen.draw([str(i) for i in range(20)])
    assert terminal.shown() == [str(i) for i in range(LINES - 1)]


def test_a_bar_stands_below_what_is_said_and_is_full_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 0.0
    monkeypatch.setattr("armctl.cli.screen.time.monotonic", lambda: now_s)
    output, terminal = Output(), Terminal()
    output.console = output.messages = Screen(file=terminal, columns=COLUMNS)
    with output.progress("guiding", 4.0) as show:
        now_s += 90.0
        show(1.0, "first take")
        assert terminal.shown() == [f"{'guiding':<24} {filled(0.25, 20)} 0:04:30 first"]
        output.warn("a reply was lost")
        assert terminal.shown() == ["a reply was lost"]
        now_s += REDRAWN_S / 2.0
        show(1.5)  # too soon to be drawn
        assert len(terminal.shown()) == 1
        now_s += REDRAWN_S
        show(2.0, "1.3 mm")
        assert filled(0.5, 20) in terminal.shown()[1]
    output.say("done")
    assert terminal.shown() == ["a reply was lost", f"{'guiding':<24} {filled(1.0, 20)} 0:00:00 1.3 mm", "done"]


def test_a_bar_of_work_that_has_hardly_begun_tells_no_nonsense() -> None:
    output, terminal = Output(), Terminal()
    output.messages = Screen(file=terminal, columns=COLUMNS)
    with output.progress("moving", 1.0) as show:
        for done in (0.0, 5e-324, 1e-17):
            show(done)


def test_what_is_said_takes_the_place_of_another_programs_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal, file = Terminal(), io.StringIO()
    for stream in (terminal, file):
        monkeypatch.setattr("sys.stderr", stream)
        stream.write("a hand guides ━━━╌╌╌")
        Screen(error=True).print("recording", "guide it")
    assert terminal.shown() == ["recording", "guide it"]
    assert file.getvalue() == "a hand guides ━━━╌╌╌recording\nguide it\n"


def test_a_dumb_terminal_is_sent_lines_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "dumb")
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    output = Output()
    with output.progress("moving", 1.0) as show:
        show(0.5)
    output.warn("a reply was lost")
    assert "\x1b" not in terminal.getvalue()
    assert terminal.getvalue().endswith("a reply was lost\n")


def test_a_terminal_that_does_not_say_its_height_shows_every_line(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(os, "get_terminal_size", lambda _: os.terminal_size((0, 0)))
    monkeypatch.setattr(terminal, "fileno", lambda: 1)
    Screen(file=terminal).draw(["one", "two"])
    assert terminal.shown() == ["one", "two"]


def test_work_that_fails_leaves_no_bar_before_the_error() -> None:
    output, terminal = Output(), Terminal()
    output.messages = Screen(file=terminal, columns=COLUMNS)
    with suppress(OSError), output.progress("guiding", 4.0) as show:
        show(1.0)
        raise OSError
    output.warn("no space left")
    assert terminal.shown() == ["no space left"]


def test_colours_are_for_terminals_and_for_those_who_want_them(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "\x1b[31m" in Screen(file=Terminal()).styled("hot", fg="red")
    assert Screen(file=io.StringIO()).styled("hot", fg="red") == "hot"
    monkeypatch.setenv("TERM", "dumb")
    assert Screen(file=Terminal()).styled("hot", fg="red") == "hot"
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("NO_COLOR", "")
    assert Screen(file=Terminal()).styled("hot", fg="red") == "hot"


def test_a_line_is_as_wide_as_the_person_or_the_terminal_says(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Screen(file=io.StringIO())
    assert screen.width == 80
    for columns, width in (("132", 132), ("nonsense", 80), ("20", 20)):
        monkeypatch.setenv("COLUMNS", columns)
        assert screen.width == width
    assert screen.wrapped("abc " * 10 + "\n\n  next: x", fg="red") == ["abc abc abc abc abc"] * 2 + ["", "  next: x"]
