from pathlib import Path

from armctl.cli.study import COMMANDS
from armctl.lab.study.studies import STUDIES
from tests.cli.conftest import Answer, Typed

LINE = ["--from", "0.18,-0.1,0.10", "--to", "0.18,0.1,0.10"]


def test_every_study_stands_in_the_table_of_commands_and_in_that_of_the_work() -> None:
    assert list(COMMANDS) == list(STUDIES)
    assert all((command.file is None) == (STUDIES[name].write is None) for name, command in COMMANDS.items())


def test_settings_of_the_genetic_algorithm_repeat_by_their_seed_whoever_works(answer: Answer) -> None:
    asked = ["ga", *LINE, "--population", "10,20", "--pc", "0.6", "--pm", "0.01", "--generations", "10"]
    alone = answer("study", *asked, "--repeats", "2", "--seed", "4", "--workers", "1")
    assert alone == answer("study", *asked, "--repeats", "2", "--seed", "4", "--workers", "2")
    assert [row["population"] for row in alone["rows"]] == [10, 20]


def test_arms_tell_each_row_and_their_summary(answer: Answer) -> None:
    found = answer("study", "arms", *LINE, "--via", "1", "--arms", "2", "--refine", "0", "--workers", "1")
    assert [row["arm"] for row in found["rows"]] == [0, 1]
    (one,) = found["summary"]
    assert one["arms"] == 2
    assert one["truth"]["mean_error_mm"]["worst"] >= one["truth"]["mean_error_mm"]["median"] > 0.0


def test_fronts_are_told_and_drawn(answer: Answer, tmp_path: Path) -> None:
    page = tmp_path / "pareto.html"
    asked = [*LINE, "--via", "1,2", "--durations", "4,3", "--workers", "1"]
    found = answer("study", "pareto", *asked, "--report", page)
    assert [(row["duration_s"], row["via"]) for row in found["rows"]] == [(3.0, 1), (3.0, 2), (4.0, 1), (4.0, 2)]
    assert any(row["front_duration"] for row in found["rows"])
    assert page.read_text().count('<figure role="img"') == 2


def test_the_tables_for_people_come_out_too(typed: Typed) -> None:
    said = typed("study", "arms", *LINE, "--via", "1", "--arms", "1", "--refine", "0", "--workers", "1")
    assert "True distance from the line on 1 arms" in said.out


def test_a_workbook_that_exists_is_told_before_the_work(typed: Typed, tmp_path: Path) -> None:
    book = tmp_path / "angles.xlsx"
    book.touch()
    said = typed("study", "paper", *LINE, "--xlsx", book, status=1)
    assert "exists already" in said.err
    assert "experiments ..." not in said.err
