from collections import Counter

import click
import pytest
from pydantic import BaseModel

from armctl.cli import cli
from armctl.cli.help import TOPICS, key_comments
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


def test_help_lists_its_topics(typed: Typed) -> None:
    said = typed("help")
    assert all(f"  {topic} " in said.out for topic in TOPICS)


@pytest.mark.parametrize("topic", TOPICS)
def test_every_topic_is_explained(topic: str, typed: Typed, answer: Answer) -> None:
    assert answer("help", topic)["text"].startswith("# ")
    assert len(typed("help", topic).out) > 300


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
