from __future__ import annotations

import json

import pytest
from pydantic import BaseModel

from armctl.cli import _COMMANDS, cli, main
from armctl.cli.help import TOPICS, attribute_docstrings
from armctl.config import ArmConfig, Compliance, Config, GripperConfig, JointConfig, LogConfig


def test_help_lists_its_topics(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help"]) == 0
    told = capsys.readouterr().out
    assert all(f"  {topic} " in told for topic in TOPICS)


@pytest.mark.parametrize("topic", TOPICS)
def test_every_topic_is_explained(topic: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help", topic, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["text"].startswith("# ")
    assert main(["help", topic]) == 0
    assert len(capsys.readouterr().out) > 300


def test_an_unknown_topic_is_wrong_usage_and_names_the_topics(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help", "nothing"]) == 2
    assert "topics: start" in capsys.readouterr().err


@pytest.mark.parametrize("command", _COMMANDS)
def test_every_command_explains_itself_within_80_columns(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        cli.main([command, "--help"], terminal_width=80)
    told = capsys.readouterr().out
    assert told.startswith("Usage: ")
    assert max(map(len, told.splitlines())) <= 80


@pytest.mark.parametrize("model", [ArmConfig, Compliance, Config, GripperConfig, JointConfig, LogConfig])
def test_every_key_says_what_it_is_for(model: type[BaseModel]) -> None:
    assert set(attribute_docstrings(model)) >= set(model.model_fields)
