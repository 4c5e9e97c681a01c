"""One suite, three transports: virtual clock, pseudo terminal, and with `--hardware PORT` an arm on somebody's desk.

    pytest tests/conformance                                  both simulated transports
    pytest tests/conformance --hardware /dev/ttyUSB0          a real bus; nothing moves, every write is undone
    pytest tests/conformance --hardware ... --hardware-may-move

On hardware the servos must be limp, and what only a power cycle or a wizard could undo is left out.
"""

import contextlib
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from armctl.clock import NS_PER_S, Clock, MonotonicClock, VirtualClock
from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import ErrorBit, Register
from armctl.dynamixel.packet import BROADCAST_ID, Decoder, Instruction, Packet, encode_instruction
from armctl.dynamixel.port import ServoPort
from armctl.dynamixel.serial_port import SerialPort
from armctl.dynamixel.servos import DEFAULT, MODELS
from armctl.files import load_arm
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.loopback import LoopbackPort

SIMULATOR = (sys.executable, "-m", "armctl", "sim", "--seed", "1", "--link")
BAUD = 1_000_000
# Where servos are looked for on hardware.
SCANNED_IDS = range(30)
# How long a line must say nothing to count as silent; a real adapter may hold bytes back for 16 ms.
QUIET_MS = {"loopback": 20.0, "pty": 8.0, "hardware": 40.0}
# How long a reply that is due may take.
PATIENCE_NS = 2 * NS_PER_S
# Addresses put back after each test: all that is writable and neither id, goal nor speed.
UNDONE = (*range(4, 19), *range(24, 30), 34, 35, 48, 49)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--hardware", metavar="PORT", help="run the conformance suite on the servos of this port")
    parser.addoption("--hardware-may-move", action="store_true", help="allow tests that energise and move servos")


class Wire:
    """A line with servos, as bytes: what a test sends, and all that comes back."""

    def __init__(self, kind: str, port: ServoPort, clock: Clock, bus: SimulatedBus | None = None) -> None:
        self.kind, self.port, self.clock, self._bus = kind, port, clock, bus
        self.servo_ids: tuple[int, ...] = ()
        # What its servos say of themselves.
        self.model_number = ax12a.MODEL_NUMBER

    def sleep(self, duration_s: float) -> None:
        self.clock.sleep_until_ns(self.clock.now_ns() + round(duration_s * 1e9))

    def host_baud(self, baud: int) -> None:
        """Set the host's side of the line."""
        self.port.setBaudRate(baud)

    def send(self, *pieces: bytes, gap_s: float = 0.0) -> None:
        """Send bytes as they are, with a pause between the pieces."""
        self.port.clearPort()
        for index, piece in enumerate(pieces):
            if index:
                self.sleep(gap_s)
            assert self.port.writePort(list(piece)) == len(piece)

    def hear(self, size: int = 250) -> bytes:
        """What comes, up to `size` bytes, until the line is quiet."""
        heard = b""
        while len(heard) < size:
            self.port.setPacketTimeoutMillis(QUIET_MS[self.kind])
            data = self.port.readPort(size - len(heard) if self._bus is not None else 1 if not heard else 250)
            if not data:
                break
            heard += data
        return heard

    def talk(self, *pieces: bytes, gap_s: float = 0.0, size: int = 250) -> bytes:
        """Send, then hear."""
        self.send(*pieces, gap_s=gap_s)
        return self.hear(size)

    def ask(self, servo_id: int, instruction: int, parameters: bytes = b"", reply_size: int = 0) -> Packet:
        """The one status packet that answers an instruction; `reply_size` is the number of its parameters."""
        self.send(encode_instruction(servo_id, instruction, parameters))
        # A reply is sure to come, so a machine that runs other tests may take its time.
        deadline_ns, heard = self.clock.now_ns() + PATIENCE_NS, b""
        while len(heard) < 4 or len(heard) < heard[3] + 4:
            heard += self.hear(max(1, 6 + reply_size - len(heard)))
            if self.clock.now_ns() >= deadline_ns:
                break
        found = Decoder().feed(heard)
        assert len(found) == 1, f"servo {servo_id}, instruction {instruction:#x}: heard {heard.hex(' ') or 'nothing'}"
        (status,) = found
        assert isinstance(status, Packet)
        assert status.servo_id == servo_id
        return status

    def read(self, servo_id: int, begin: int, size: int) -> bytes:
        status = self.ask(servo_id, Instruction.READ, bytes((begin, size)), size)
        assert status.code & ErrorBit.RANGE == 0
        assert len(status.parameters) == size
        return status.parameters

    def read_behind(self, servo_id: int, begin: int, size: int) -> bytes:
        """As `read`, behind writes that may have been answered: a busy machine brings such an answer late."""
        self.send(encode_instruction(servo_id, Instruction.READ, bytes((begin, size))))
        deadline_ns, heard = self.clock.now_ns() + PATIENCE_NS, b""
        while self.clock.now_ns() < deadline_ns:
            heard += self.hear()
            for packet in Decoder().feed(heard):
                if isinstance(packet, Packet) and len(packet.parameters) == size:
                    return packet.parameters
        raise AssertionError(f"servo {servo_id}: heard {heard.hex(' ') or 'nothing'}")

    def value(self, servo_id: int, register: Register) -> int:
        return int.from_bytes(self.read(servo_id, register.address, register.size), "little")

    def write(self, servo_id: int, address: int, data: bytes) -> ErrorBit:
        """Write bytes; the error bits that answer."""
        status = self.ask(servo_id, Instruction.WRITE, bytes((address,)) + data)
        assert status.parameters == b""
        return ErrorBit(status.code)

    def put(self, servo_id: int, register: Register, value: int) -> ErrorBit:
        return self.write(servo_id, register.address, value.to_bytes(register.size, "little"))

    def silent(self, *pieces: bytes, gap_s: float = 0.0) -> bool:
        return self.talk(*pieces, gap_s=gap_s) == b""

    def broadcast(self, instruction: int, parameters: bytes = b"") -> None:
        assert self.silent(encode_instruction(BROADCAST_ID, instruction, parameters))


# Models whose servos keep the same rules, each played by a whole arm of them.
OTHERS = tuple(name for name in MODELS if name != DEFAULT)


@contextlib.contextmanager
def serial_wire(kind: str, path: str) -> Iterator[Wire]:
    clock = MonotonicClock()
    port = SerialPort(path, BAUD, clock)
    port.openPort()
    try:
        yield Wire(kind, port, clock)
    finally:
        port.closePort()


@contextlib.contextmanager
def simulator(link: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """The simulator as a program, until the end of the block."""
    command = [*SIMULATOR, str(link), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == f"ready {link}\n"
            yield process
        finally:
            process.terminate()
            process.wait(10.0)


@contextlib.contextmanager
def opened(kind: str, folder: Path, hardware: str | None) -> Iterator[Wire]:
    """A wire of that kind, with the servos found on it."""
    with contextlib.ExitStack() as cleanup:
        if kind in ("loopback", *MODELS):
            arm = load_arm("ax12-line")
            joints = [joint.model_copy(update={"model": kind} if kind in MODELS else {}) for joint in arm.joints]
            arm = arm.model_copy(update={"joints": tuple(joints)})
            clock, bus = VirtualClock(), SimulatedBus(SimulatedArm(arm, seed=1))
            port = LoopbackPort(bus, clock)
            port.openPort()
            wire = Wire("loopback", port, clock, bus)
            wire.model_number = MODELS[arm.joints[0].model].model_number
        elif kind == "pty":
            cleanup.enter_context(simulator(folder / "port"))
            wire = cleanup.enter_context(serial_wire("pty", str(folder / "port")))
        else:
            assert hardware is not None
            wire = cleanup.enter_context(serial_wire("hardware", hardware))
        wire.servo_ids = tuple(scan(wire, SCANNED_IDS if kind == "hardware" else range(9)))
        if not wire.servo_ids:
            pytest.exit(f"no servo with an id in {SCANNED_IDS} answers on {hardware} at {BAUD} baud", 2)
        if any(wire.value(servo_id, ax12a.TORQUE_ENABLE) for servo_id in wire.servo_ids):
            pytest.exit("a servo is under torque; support the arm and switch its torque off first", 2)
        yield wire


def scan(wire: Wire, ids: Sequence[int]) -> list[int]:
    return [i for i in ids if wire.talk(encode_instruction(i, Instruction.PING), size=6)]


def transports(config: pytest.Config) -> list[str]:
    return ["hardware"] if config.getoption("--hardware", default=None) else ["loopback", *OTHERS, "pty"]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    for name in ("wire", "spare"):
        if name in metafunc.fixturenames:
            kinds = transports(metafunc.config)
            marked = [pytest.param(kind, marks=pytest.mark.pty) if kind == "pty" else kind for kind in kinds]
            metafunc.parametrize(name, marked, indirect=True, scope="session" if name == "wire" else "function")


@pytest.fixture(scope="session")
def wire(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Wire]:
    hardware = request.config.getoption("--hardware", default=None)
    with opened(request.param, tmp_path_factory.mktemp("sim"), hardware) as found:
        yield found


@pytest.fixture
def servo(wire: Wire) -> Iterator[int]:
    """Id of the first servo; what a test changes in it is put back."""
    servo_id = wire.servo_ids[0]
    before = wire.read(servo_id, 0, ax12a.TABLE_SIZE)
    yield servo_id
    # Silent or not, by whatever status return level the test has left.
    wire.talk(encode_instruction(servo_id, Instruction.WRITE, bytes((ax12a.TORQUE_ENABLE.address, 0))))
    wire.talk(encode_instruction(servo_id, Instruction.WRITE, bytes((ax12a.RETURN_LEVEL.address, 2))))
    after = wire.read_behind(servo_id, 0, ax12a.TABLE_SIZE)
    for register in ax12a.REGISTERS:
        place = slice(register.address, register.address + register.size)
        if register.address in UNDONE and register.writable and before[place] != after[place]:
            assert not wire.write(servo_id, register.address, before[place]) & ErrorBit.RANGE


@pytest.fixture
def may_move(request: pytest.FixtureRequest) -> None:
    """For tests that energise a servo."""
    config = request.config
    if config.getoption("--hardware", default=None) and not config.getoption("--hardware-may-move"):
        pytest.skip("energises a servo; allow it with --hardware-may-move")


@pytest.fixture
def spare(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Wire]:
    """An arm of its own, for what only a power cycle or a wizard would undo."""
    if request.param == "hardware":
        pytest.skip("would leave the servo changed; simulators only")
    with opened(request.param, tmp_path, None) as found:
        yield found
