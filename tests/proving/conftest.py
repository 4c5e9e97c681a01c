"""Arms before a judge, in the states that most tests begin with."""

import pytest

from tests.proving.judged import Bench, running


@pytest.fixture
def limp() -> Bench:
    return Bench(torque=False)


@pytest.fixture
def holding() -> Bench:
    return Bench()


@pytest.fixture
def moving() -> Bench:
    return running()
