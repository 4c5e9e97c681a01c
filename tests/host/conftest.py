"""The arm as all clients share it, ready for a test."""

from collections.abc import Iterator

import pytest

from tests.host.bench import Bench
from tests.host.doubles import InlineExecutor


@pytest.fixture
def executor() -> InlineExecutor:
    return InlineExecutor()


@pytest.fixture
def bench(request: pytest.FixtureRequest, executor: InlineExecutor) -> Iterator[Bench]:
    """A host over ideal servos; indirect parameters are changes of the arm's calibration."""
    found = Bench(**getattr(request, "param", {}))
    yield found
    found.control.die()
    found.control.link.close()
