"""What stands in a text, or in a list of texts."""

from collections.abc import Container


def missing(told: Container[str], *words: str) -> list[str]:
    """Those of the words that do not stand in it."""
    return [word for word in words if word not in told]
