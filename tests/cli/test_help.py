import io
import re
from collections import Counter

import click
import pytest
from pydantic import BaseModel

from armctl.cli import cli
from armctl.cli.help import TOPICS, key_comments, page, shown
from armctl.cli.screen import Screen
from armctl.config import (
    ArmConfig,
    ChainRow,
    ChainTable,
    Compliance,
    Config,
    GripperConfig,
    JointConfig,
    LogConfig,
    OwnGripper,
)
from tests.cli.conftest import Answer, Typed


def test_the_first_line_of_jog_says_how_long_it_moves(typed: Typed) -> None:
    assert "for --seconds (1 unless given)" in " ".join(typed("jog", "--help").out.split())


def test_help_lists_its_topics(typed: Typed) -> None:
    said = typed("help")
    assert all(f"  {topic} " in said.out for topic in TOPICS)


@pytest.mark.parametrize("topic", TOPICS)
def test_every_topic_is_explained(topic: str, typed: Typed, answer: Answer) -> None:
    assert answer("help", topic)["text"].startswith("# ")
    assert len(typed("help", topic).out) > 300


@pytest.mark.parametrize("topic", TOPICS)
def test_a_page_is_shown_whole_and_fits(topic: str) -> None:
    """Every word stands there in its order, every line of code as it is to be typed; no mark of Markdown is left."""
    text = page(topic)
    lines = list(shown(text, Screen(file=io.StringIO(), columns=80)))
    parts = re.findall(r"^```.*\n((?:.*\n)*?)```", text, re.MULTILINE)
    unfenced = re.sub(r"^```.*\n((?:.*\n)*?)```", "", text, flags=re.MULTILINE)
    indented = re.findall(r"(?<=\n\n)((?: {4}.*\n)+)", unfenced)
    code = [f"  {line}" for part in parts for line in part.splitlines()]
    typed = [line[2:] for part in indented for line in part.splitlines()]
    assert max(map(len, lines)) <= 80
    places = iter(lines)
    assert all(line in places for line in code)
    places = iter(lines)
    assert all(line in places for line in typed)
    assert not [line for line in lines if line not in code + typed and re.search(r"```|\|-|^#|\*\*\w.*\*\*|\]\(", line)]
    prose = re.sub(r"^```.*|(?<=\])\([^)]*\)|^\|[^`\n]*\|-", "", text, flags=re.MULTILINE)
    words = re.findall(r"\w+", re.sub(r"^\|.*", "", prose, flags=re.MULTILINE))
    said = iter(re.findall(r"\w+", "\n".join(lines)))
    assert all(word in said for word in words)
    assert set(re.findall(r"\w+", prose)) <= set(re.findall(r"\w+", "\n".join(lines)))


def test_an_option_that_is_kept_has_a_name_of_its_own() -> None:
    def look(command: click.Command, typed: str) -> None:
        names = Counter(parameter.name for parameter in command.params)
        assert {
            parameter.name for parameter in command.params if not parameter.expose_value and names[parameter.name] > 1
        } == set(), typed
        for name, one in getattr(command, "commands", {}).items():
            look(one, f"{typed} {name}")

    for name in cli.list_commands(click.Context(cli)):
        one = cli.get_command(click.Context(cli), name)
        assert one is not None
        look(one, name)


MODELS = (ArmConfig, ChainRow, ChainTable, Compliance, Config, GripperConfig, JointConfig, LogConfig, OwnGripper)


@pytest.mark.parametrize("model", MODELS)
def test_every_key_says_what_it_is_for(model: type[BaseModel]) -> None:
    assert set(key_comments(model)) >= set(model.model_fields)
