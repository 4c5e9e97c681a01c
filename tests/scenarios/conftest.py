"""One simulated arm for all scenarios that move it: bringing it up takes longer than any of them."""

from collections.abc import Iterator

import pytest

from tests.scenarios.bench import Bench, Simulator, bench, bring_up, simulator


@pytest.fixture(scope="session")
def arm() -> Iterator[Simulator]:
    """A simulated arm, left in whatever pose and torque the scenario before left it."""
    with simulator() as found:
        yield found


@pytest.fixture
def holding(arm: Simulator) -> Iterator[Bench]:
    """A daemon that holds the arm somewhere on the line."""
    with bench(arm.port) as found:
        found.start_daemon()
        bring_up(found, arm)
        yield found
