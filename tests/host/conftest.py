"""The arm as all clients share it, ready for a test."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from proving.hosted_arm import Inline
from tests.genetic import hand
from tests.host.bench import Bench
from tests.host.doubles import write_take


@pytest.fixture
def executor() -> Inline:
    return Inline()


@pytest.fixture
def fresh(request: pytest.FixtureRequest, executor: Inline) -> Iterator[Bench]:
    """A host over ideal servos before its first tick; indirect parameters are changes of the arm's calibration."""
    found = Bench(**getattr(request, "param", {}))
    yield found
    found.control.die()
    found.control.link.close()


@pytest.fixture
def taken(tmp_path: Path) -> Path:
    """A folder with two takes of a hand, a and b."""
    for name, samples in zip("ab", hand.recordings(2, seed=1), strict=True):
        write_take(tmp_path / f"{name}.mcap", samples, hand.arm())
    return tmp_path


@pytest.fixture
def limp(fresh: Bench) -> Bench:
    """A host over ideal servos without torque, after its first tick."""
    fresh.tick()
    return fresh


@pytest.fixture
def bench(limp: Bench) -> Bench:
    """A host over ideal servos that hold."""
    return asyncio.run(limp.holding())
