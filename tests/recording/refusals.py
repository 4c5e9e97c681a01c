"""What cannot be done with a log."""

from collections.abc import Callable
from typing import Any

import pytest

from armctl.errors import LogError


def cannot(act: Callable[..., object], *given: Any, why: str | None = None, **named: Any) -> None:
    """The act is refused with an error of the log, in words that match `why`."""
    with pytest.raises(LogError, match=why):
        act(*given, **named)
