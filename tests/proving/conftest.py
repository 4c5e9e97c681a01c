"""Arms before a judge, in the states that most tests begin with."""

import logging
from collections.abc import Iterator

import pytest

from tests.proving.judged import Bench, running


@pytest.fixture(autouse=True)
def loud() -> Iterator[None]:
    """A proof silences its process; the tests after it are not to be."""
    yield
    logging.disable(logging.NOTSET)


@pytest.fixture
def limp() -> Bench:
    return Bench(torque=False)


@pytest.fixture
def holding() -> Bench:
    return Bench()


@pytest.fixture
def moving() -> Bench:
    return running()
