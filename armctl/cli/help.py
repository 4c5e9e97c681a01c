"""`armctl help [TOPIC]`: the pages of armctl/docs, and two that are made from the code. `armctl completion`."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent, wrap
from typing import TYPE_CHECKING, Any

import click
import yaml

from armctl.cli.output import Output, command
from armctl.cli.screen import Screen
from armctl.cli.tables import table_lines
from armctl.errors import ConfigError

if TYPE_CHECKING:
    from pydantic import BaseModel


DOCS = Path(__file__).resolve().parent.parent / "docs"
# Each page, and what it explains.
TOPICS: dict[str, str] = yaml.safe_load((DOCS / "topics.yaml").read_text(encoding="utf-8"))
# What stands in the pages that are made from the code, around what is made.
TEXTS: dict[str, dict[str, Any]] = yaml.safe_load((DOCS / "made.yaml").read_text(encoding="utf-8"))


@command("help")
def help_command(output: Output, topic: str | None) -> None:
    """Explain TOPIC; without one, list the topics.

    Example: armctl help start
    """
    if topic is None:
        topics = "\n".join(f"  {name:<14}{text}" for name, text in TOPICS.items())
        output.answer({"topics": TOPICS}, f"armctl help TOPIC:\n{topics}\narmctl COMMAND --help explains a command.")
        return
    text = page(topic)
    if not output.result({"topic": topic, "text": text}):
        output.console.print(*shown(text, output.console))


# Wider lines are hard to read, however wide the screen.
WIDEST = 100
# Parts of a page: code, between fences or indented; a table; an item or a heading with its mark, or a paragraph.
PARTS = re.compile(
    r"^```.*\n((?:.*\n)*?)```\n|^((?: {4}.*\n)+)|((?:^\|.*\n)+)"
    r"|^( *(?:[-*]|\d+\.) |#+ )?((?:(?!```| *- |\||#).+(?:\n|$))+)",
    re.MULTILINE,
)
# Within a line: what stands for a picture, a link and stressed words.
WITHIN = (
    (r"!\[([^]]*)\]\([^)]*\)", r"(picture: \1)"), (r"\[([^]]*)\]\(([^)]*)\)", r"\1 (\2)"), (r"\*+(\w[^*]*)\*+", r"\1"),
)  # fmt: skip


def shown(text: str, screen: Screen) -> Iterator[str]:
    """The lines in which a page of Markdown is shown: as it is written, wrapped, tables as those of the commands."""
    width = min(screen.width, WIDEST)
    for fenced, indented, table, mark, words in PARTS.findall(text + "\n"):
        plain = table or " ".join(words.split())
        for pattern, instead in WITHIN:
            plain = re.sub(pattern, instead, plain)
        item = "" if mark.startswith("#") else mark
        yield from [""] * (not item)
        if fenced or indented:
            yield from (f"  {line}" for line in (fenced or dedent(indented)).splitlines())
        elif table:
            columns, _, *rows = ([cell.strip() for cell in line.split("|")[1:-1]] for line in plain.splitlines())
            yield from table_lines(screen, columns, rows, columns, width=width)
        else:
            lines = wrap(plain, width, initial_indent=item, subsequent_indent=" " * len(item), break_on_hyphens=False)
            yield from (screen.styled(line, bold=item != mark or None) for line in lines)


def page(topic: str) -> str:
    """A page as Markdown.

    Raises:
        ConfigError: no such topic; names those there are.
    """
    if topic not in TOPICS:
        raise ConfigError("armctl help", topic, "no such topic", f"topics: {', '.join(TOPICS)}")
    return MADE[topic]() if topic in MADE else (DOCS / f"{topic}.md").read_text(encoding="utf-8")


def faults_page() -> str:
    """Every code a fault can latch with, from the table the cards are made from."""
    from armctl.control.faults import FAULTS

    told = TEXTS["faults"]
    cards = [
        f"## {kind.code}\n\n{kind.what[0].upper()}{kind.what[1:]}.{told['to_rest'] if kind.to_rest else ''}\n\n"
        f"*Next:* {kind.remedy}.\n"
        for kind in FAULTS
    ]
    return "\n".join([told["intro"], *cards])


def configuration_page() -> str:
    """Every key with its type, default and bounds, from the types that check the files."""
    from armctl import config

    told = TEXTS["configuration"]
    sections = (f"## {heading}\n{_keys(getattr(config, model))}" for model, heading in told["sections"].items())
    return "\n".join([told["intro"], *sections])


MADE = {"configuration": configuration_page, "faults": faults_page}
# Type in JSON's words -> what a person calls it.
KINDS = {"string": "text", "integer": "whole number", "array": "list", "object": "names and values"}
BOUNDS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}


def _keys(model: type[BaseModel]) -> str:
    """A line a key: type, default, bounds, and what the source says about it."""
    schema = model.model_json_schema()
    said = key_comments(model)
    rows = []
    for key, about in schema["properties"].items():
        facts = [_kind(about), "required" if key in schema.get("required", ()) else _default(about.get("default"))]
        facts += [f"{sign} {about[word]:.15g}" for word, sign in BOUNDS.items() if word in about]
        text = f". {said[key]}" if key in said else ""
        rows.append(f"- `{key}` ({', '.join(filter(None, facts))}){text}")
    return "\n".join(rows) + "\n"


def _kind(about: dict[str, Any]) -> str:
    if "enum" in about:
        return "one of " + ", ".join(map(str, about["enum"]))
    kind = str(about.get("type", "see below"))
    return KINDS.get(kind, kind)


def _default(default: object) -> str:
    """What stands where the key is left out; empty: nothing, or what is told below."""
    return "" if default in ("", None) or isinstance(default, dict) else f"default {json.dumps(default)}"


def key_comments(model: type) -> dict[str, str]:
    """Key of a configuration -> the comment above it in the source, as one line."""
    comments = re.findall(r"((?:^    # .*\n)+)    (\w+):", inspect.getsource(model), re.MULTILINE)
    return {key: " ".join(comment.replace("    # ", "").split()) for comment, key in comments}


FILES = {"bash": "~/.bashrc", "zsh": "~/.zshrc", "fish": "~/.config/fish/completions/armctl.fish"}


@command("completion")
def completion_command(output: Output, shell: str) -> None:
    """Print what lets the Tab key finish commands and options in SHELL.

    Append its output to the file that the shell reads when it starts: ~/.bashrc, ~/.zshrc, or
    ~/.config/fish/completions/armctl.fish.

    Example: armctl completion bash >> ~/.bashrc
    """
    from click.shell_completion import get_completion_class

    from armctl.cli import cli

    kind = get_completion_class(shell)
    assert kind is not None
    script = kind(cli, {}, "armctl", "_ARMCTL_COMPLETE").source()
    output.answer({"shell": shell, "file": FILES[shell], "script": script}, lambda: click.echo(script))
