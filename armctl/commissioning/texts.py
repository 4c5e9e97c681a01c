"""What the commands that set an arm up say to the person beside it: the texts stand in `texts.toml`."""

import tomllib
from pathlib import Path

from armctl.errors import RequestRefused

TEXTS = tomllib.loads(Path(__file__).with_name("texts.toml").read_text(encoding="utf-8"))


def said(key: str, **told: object) -> str:
    """A text of the table; names in braces are filled in."""
    return str(TEXTS[key]).format(**told)


def refusal(key: str, **told: object) -> RequestRefused:
    """The refusal with a text of the table, whose key begins with its code."""
    return RequestRefused(key.split()[0], said(key, **told))
