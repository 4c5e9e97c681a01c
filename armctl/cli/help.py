"""`armctl help [TOPIC]`: the pages of armctl/docs, and two that are made from the code."""

from __future__ import annotations

from pathlib import Path

import click

from armctl.cli.output import Output, output_option
from armctl.errors import ConfigError

DOCS = Path(__file__).resolve().parent.parent / "docs"
TOPICS = {
    "start": "five minutes without an arm",
    "arm": "the first hour with a real arm",
    "concepts": "the words, and what stands behind them",
    "safety": "what armctl does for safety, and what it does not",
    "faults": "every fault code and what to do",
    "configuration": "every key of the configuration and of a calibration file",
    "api": "Python, socket and HTTP",
    "logs": "what is in a log, and what can be done with it",
    "new-arm": "how to add an arm",
    "ros2": "a log in ROS 2 tools",
    "simulator": "what is simulated, and what is not",
}


@click.command("help")
@click.argument("topic", required=False)
@output_option
def help_command(output: Output, topic: str | None) -> None:
    """Explain TOPIC; without one, list the topics.

    Example: armctl help start
    """
    if topic is None:
        if not output.result({"topics": TOPICS}):
            output.say("armctl help TOPIC:")
            for name, text in TOPICS.items():
                output.say(f"  {name:<14}{text}")
            output.say("armctl COMMAND --help explains a command.")
        return
    text = page(topic)
    if not output.result({"topic": topic, "text": text}):
        from rich.markdown import Markdown

        output.console.print(Markdown(text), width=min(output.console.width, 100))


def page(topic: str) -> str:
    """A page as Markdown.

    Raises:
        ConfigError: no such topic; names those there are.
    """
    if topic not in TOPICS:
        raise ConfigError("armctl help", topic, "no such topic", f"topics: {', '.join(TOPICS)}")
    if topic == "configuration":
        return configuration_page()
    if topic == "faults":
        return faults_page()
    return (DOCS / f"{topic}.md").read_text(encoding="utf-8")


def faults_page() -> str:
    """Every code a fault can latch with, from the table the cards are made from."""
    from armctl.control.faults import NEXT, SETTLING, WHAT

    rows = []
    for code, following in NEXT.items():
        way = " The arm goes to its rest pose and goes limp there, while it can." if code in SETTLING else ""
        rows.append(f"## {code}\n\n{WHAT[code][0].upper()}{WHAT[code][1:]}.{way}\n\n*Next:* {following}.\n")
    intro = (
        "# Faults\n\nA fault latches: the arm comes to rest, torque stays as it is, and `armctl status` shows this "
        "card until the cause is gone and you typed `armctl clear`.\n"
    )
    return "\n".join([intro, *rows])


def configuration_page() -> str:
    """Every key with its type, default and bounds, from the types that check the files."""
    from armctl.config import ArmConfig, Compliance, Config, GripperConfig, JointConfig, LogConfig

    blocks = [
        "# Configuration\n\nTwo YAML files, checked as a whole when they are read; wrong keys are named.\n",
        "## armctl.yaml\n\n`~/.config/armctl/armctl.yaml`, or `/etc/armctl/armctl.yaml` for the service. Every key "
        "has a default.\n",
        _table(Config),
        "## log:\n",
        _table(LogConfig),
        "## calibration/NAME.yaml\n\nOne file an arm; see `armctl help new-arm`.\n",
        _table(ArmConfig),
        "## joints: one entry a servo, from the base up\n",
        _table(JointConfig),
        "## compliance:\n",
        _table(Compliance),
        "## gripper: the joint that grips, where the arm has one\n",
        _table(GripperConfig),
    ]
    return "\n".join(blocks)


def _table(model: type) -> str:
    schema = model.model_json_schema()  # type: ignore[attr-defined]  # a pydantic model
    required = set(schema.get("required", ()))
    rows = ["| key | type | default | bounds |", "|-|-|-|-|"]
    for key, about in schema["properties"].items():
        default = "required" if key in required else _shown(about.get("default"))
        bounds = [
            f"{sign} {about[word]:g}"
            for word, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
            if word in about
        ]
        kind = about.get("type") or ("one of " + ", ".join(map(str, about["enum"])) if "enum" in about else "see below")
        rows.append(f"| `{key}` | {kind} | {default} | {', '.join(bounds)} |")
    return "\n".join(rows) + "\n"


def _shown(default: object) -> str:
    if default in ("", None, {}):
        return "empty"
    return f"`{default}`" if not isinstance(default, dict) else "see below"
