"""pyax12, a protocol 1.0 client with packets and timing of its own, unchanged on the simulator's pseudo terminal."""

from collections.abc import Iterator

import pytest
from pyax12.connection import Connection

from armctl.dynamixel import ax12a
from tests.conformance.conftest import simulator

pytestmark = pytest.mark.pty


@pytest.fixture(scope="module")
def connection(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Connection]:
    link = tmp_path_factory.mktemp("sim") / "port"
    with simulator(link):
        found = Connection(port=str(link), baudrate=1_000_000, timeout=0.1, waiting_time=0.01)
        yield found
        found.close()


def test_pyax12_scans(connection: Connection) -> None:
    assert list(connection.scan(range(20))) == [1, 2, 3, 4, 5, 6]


def test_pyax12_reads(connection: Connection) -> None:
    assert connection.get_model_number(2) == ax12a.MODEL_NUMBER
    assert len(connection.dump_control_table(2)) == ax12a.TABLE_SIZE
    assert connection.get_present_voltage(2) == 12.0


def test_pyax12_writes_and_moves(connection: Connection) -> None:
    before = connection.get_present_position(1)
    goal = before + 30
    connection.goto(1, goal, speed=300)
    for _ in range(100):
        if abs(connection.get_present_position(1) - goal) <= 4:
            break
    assert abs(connection.get_present_position(1) - goal) <= 4
    assert connection.get_goal_position(1) == goal
    connection.write_data(1, ax12a.TORQUE_ENABLE.address, 0)
    assert bytes(connection.read_data(1, ax12a.TORQUE_ENABLE.address, 1)) == b"\x00"
