import pytest
from pydantic import BaseModel

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


MODELS = (ArmConfig, ChainRow, ChainTable, Compliance, Config, GripperConfig, JointConfig, LogConfig, OwnGripper)


@pytest.mark.parametrize("model", MODELS)
def test_every_key_says_what_it_is_for(model: type[BaseModel]) -> None:
    assert set(key_comments(model)) >= set(model.model_fields)
