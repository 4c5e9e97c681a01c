"""SerialPort and the kernel's worker on real pseudo terminals."""

import fcntl
import os
import select
import subprocess
import sys
import termios
import threading
import time
import tty
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from armctl.clock import Clock, MonotonicClock
from armctl.dynamixel.bus import ServoBus
from armctl.dynamixel.kernel_worker import KernelWorker
from armctl.dynamixel.serial_port import SerialPort
from armctl.errors import PortBusy, PortMissing
from armctl.messages import Goal
from tests.stalled import TICK_NS, Machine

pytestmark = pytest.mark.pty
BAUD = 1_000_000
LATE_NS = 5_000_000
PATIENT_NS = 60_000_000_000


class Pty:
    """A pseudo terminal whose master side the test plays."""

    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)

    def unplug(self) -> None:
        for fd in (self.slave, self.master):
            if fd >= 0:
                os.close(fd)
        self.master = self.slave = -1


@pytest.fixture
def pty() -> Iterator[Pty]:
    pty = Pty()
    yield pty
    pty.unplug()


@pytest.fixture
def port(pty: Pty) -> Iterator[SerialPort]:
    port = SerialPort(pty.path, BAUD, MonotonicClock())
    port.openPort()
    yield port
    port.closePort()


@pytest.mark.parametrize(("flags", "low_latency"), [(0x2000, True), (0, False)])
def test_low_latency_is_read_back_from_the_driver(
    monkeypatch: pytest.MonkeyPatch, port: SerialPort, flags: int, low_latency: bool
) -> None:
    def driver(fd: int, request: int, state: "array[int]") -> None:
        if request == termios.TIOCGSERIAL:
            state[4] = flags

    assert port.ser is not None
    monkeypatch.setattr(fcntl, "ioctl", driver)
    assert port._ask_low_latency(port.ser) is low_latency


def test_pty_opens_without_low_latency(port: SerialPort) -> None:
    assert port.is_open
    assert port.low_latency is None


def test_port_held_by_another_process_is_free_again_when_that_is_killed(pty: Pty) -> None:
    code = (
        "import sys, time; from armctl.clock import MonotonicClock\n"
        "from armctl.dynamixel.serial_port import SerialPort\n"
        f"port = SerialPort({pty.path!r}, {BAUD}, MonotonicClock()); port.openPort(); print('open', flush=True)\n"
        "time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"open\n"
        port = SerialPort(pty.path, BAUD, MonotonicClock())
        with pytest.raises(PortBusy, match=rf"in use by .*\(pid {process.pid}\)"):
            port.openPort()
        process.kill()
    port.openPort()
    port.closePort()
    mark = array("i", [1])
    fcntl.ioctl(pty.slave, 0x80045440, mark)  # TIOCGEXCL
    assert mark[0] == 0, "an exclusive mark would outlive a killed owner and lock out everybody but root"


def test_opening_again_and_changing_baud_leak_no_descriptors(port: SerialPort) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(5):
        port.openPort()
        port.setBaudRate(57_600)
    assert len(os.listdir("/proc/self/fd")) == before
    assert port.byte_ns == 173_611
    port.closePort()
    port.closePort()
    assert len(os.listdir("/proc/self/fd")) < before


# -------------------------------------------------------------------------------------------- reading, writing


def test_waiting_for_a_reply_burns_no_cpu_and_ends_at_the_deadline(port: SerialPort) -> None:
    begin_s, begin_cpu_s = time.monotonic(), time.thread_time()
    port.setPacketTimeoutMillis(100)
    assert port.readPort(6) == b""
    assert port.isPacketTimeout()
    assert time.monotonic() - begin_s >= 0.1
    assert time.thread_time() - begin_cpu_s < 0.02


class ScriptedWorker(KernelWorker):
    """A kernel's worker with these delays [ns]; whenever it is looked at, it hands `late` on."""

    def __init__(self, pty: Pty, *delays_ns: int, late: bytes = b"") -> None:
        self.delays_ns, self.looks = delays_ns, 0
        self._pty, self._late = pty, late

    def delay_ns(self, clock: Clock, until_ns: int) -> int:
        if self._late:
            os.write(self._pty.master, self._late)
            assert select.select([self._pty.slave], [], [], 10.0)[0]
        self.looks += 1
        return self.delays_ns[self.looks - 1]


def await_reply(port: SerialPort, worker: ScriptedWorker, patience_ns: int = PATIENT_NS) -> bytes:
    port._worker = worker
    port.begin_round(patience_ns)
    port.setPacketTimeout(5)
    return port.readPort(5)


def test_a_reply_that_the_kernel_keeps_back_is_waited_for_once_more(pty: Pty, port: SerialPort) -> None:
    worker = ScriptedWorker(pty, LATE_NS, *(0,) * 9, late=b"reply")
    assert await_reply(port, worker) == b"reply"


@pytest.mark.parametrize(
    ("delays_ns", "looks"),
    [((0, 0), (1, 2)), ((LATE_NS, 0, 0, 0, 0), (3, 5))],
    ids=["where the kernel keeps up it costs no more", "behind a late worker each is waited for once more"],
)
def test_a_silent_servo_is_waited_for_as_the_kernel_keeps_up(
    pty: Pty, port: SerialPort, delays_ns: tuple[int, ...], looks: tuple[int, int]
) -> None:
    worker = ScriptedWorker(pty, *delays_ns)
    for looks_so_far in looks:
        assert await_reply(port, worker) == b""
        assert port.isPacketTimeout()
        assert worker.looks == looks_so_far


def test_what_the_kernel_keeps_back_is_drained_too(pty: Pty, port: SerialPort) -> None:
    port._worker = worker = ScriptedWorker(pty, LATE_NS, *(0,) * 9, late=b"late")
    port.begin_round(PATIENT_NS)
    assert port.drain() >= 4
    assert worker.looks >= 2


class HeldUpClock(MonotonicClock):
    """Of a machine that can stand still."""

    stood_still_ns = 0

    def now_ns(self) -> int:
        return super().now_ns() + self.stood_still_ns


@pytest.mark.parametrize(("still_ms", "reply"), [(60, b"reply"), (0, b"")])
def test_a_reply_is_waited_for_once_more_where_nothing_was_run_meanwhile(
    pty: Pty, monkeypatch: pytest.MonkeyPatch, still_ms: int, reply: bytes
) -> None:
    port = SerialPort(pty.path, BAUD, clock := HeldUpClock())
    port.openPort()
    wait, ends = select.select, 0

    def stand_still(*what: Any) -> Any:
        nonlocal ends
        found = wait(*what)
        ends += 1
        if ends == 1:
            clock.stood_still_ns = still_ms * 1_000_000
        if ends == 1 and still_ms:
            os.write(pty.master, reply)
        return found

    monkeypatch.setattr(select, "select", stand_still)
    port._worker = None
    port.begin_round(PATIENT_NS)
    port.setPacketTimeout(5)
    assert port.readPort(5) == reply
    port.closePort()


@pytest.mark.parametrize(("stalled", "reply"), [(8, b"reply"), (0, b"")])
def test_a_reply_is_waited_for_as_long_as_a_processor_of_a_virtual_machine_was_not_run(
    pty: Pty, port: SerialPort, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stalled: int, reply: bytes
) -> None:
    machine = Machine(tmp_path)
    port._stalls, port._worker = machine.stalls, None
    port.begin_round(PATIENT_NS)
    machine.run(stalled, (0,))
    wait, ends = select.select, 0

    def late(*what: Any) -> Any:
        nonlocal ends
        ends += 1
        if ends == 3 and reply:
            os.write(pty.master, reply)
        return wait(*what)

    monkeypatch.setattr(select, "select", late)
    for expected, least in ((reply, 3 if stalled else 1), (b"", 1)):
        ends = 0
        port.setPacketTimeout(5)
        assert port.readPort(5) == expected
        reply = b""
        assert least <= ends < least + 60
    waited_ns = port._made_up_ns
    assert (waited_ns > 0) == (stalled > 0)
    assert waited_ns < stalled * TICK_NS + port._allowed_ns, "no longer in all, whoever is silent"


def test_patience_ends(pty: Pty, port: SerialPort) -> None:
    worker = ScriptedWorker(pty)
    assert await_reply(port, worker, patience_ns=0) == b""
    assert port.drain() == 0
    assert worker.looks == 0


def test_line_that_takes_no_more_drops_what_waits(pty: Pty, port: SerialPort) -> None:
    sent = [port.writePort([0x55] * 200) for _ in range(1000)]
    assert sent[0] == 200
    assert min(sent) < 200


def test_unplugging_in_the_middle_of_a_read_is_data(pty: Pty, port: SerialPort) -> None:
    bus = ServoBus(port, (1, 2))
    bus.open()
    port.allow_latency(5000.0)

    def unplug_after_the_request() -> None:
        os.read(pty.master, 8)
        os.write(pty.master, b"\xff\xff\x01")
        pty.unplug()

    hand = threading.Thread(target=unplug_after_the_request)
    hand.start()
    sample = bus.read_sample()
    hand.join()
    assert not sample.port_open
    assert [(reading.fresh, reading.problem) for reading in sample.servos] == [(False, "PORT_GONE")] * 2
    assert not bus.is_open
    assert not port.is_using
    assert not bus.write_goal(Goal((512, 512), (10, 10)))
    bus.close()
    with pytest.raises(PortMissing):
        bus.open()


def test_after_a_replug_the_same_adapter_is_opened_under_its_new_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armctl.dynamixel.serial_port.BY_ID", tmp_path)
    before, other, after = Pty(), Pty(), Pty()
    identity = tmp_path / "usb-FTDI_A9"
    (tmp_path / "usb-FTDI_B1").symlink_to(other.path)
    identity.symlink_to(before.path)
    port = SerialPort(before.path, 1_000_000, MonotonicClock())
    port.openPort()
    port.closePort()
    identity.unlink()
    with pytest.raises(PortMissing, match="usb-FTDI_A9"):
        port.openPort()  # another device may have the old name by now
    identity.symlink_to(after.path)
    port.openPort()
    assert port.ser is not None
    assert os.fstat(port.ser.fileno()).st_rdev == os.stat(after.path).st_rdev
    port.closePort()
    for pty in (before, other, after):
        pty.unplug()


# ------------------------------------------------------------------------------ the byte that overtakes no other


class StuckWorker(KernelWorker):
    """One whose bytes go no farther than `hand_on` lets them."""

    def __init__(self) -> None:
        super().__init__()
        self._through = os.dup(self._near)
        self._kept, ours = os.pipe()
        os.dup2(ours, self._near)
        os.close(ours)

    def hand_on(self) -> bytes:
        kept = os.read(self._kept, 256)
        os.write(self._through, kept)
        return kept

    def close(self) -> None:
        super().close()
        os.close(self._through)
        os.close(self._kept)


def test_a_byte_comes_through_again_and_again() -> None:
    worker, clock = KernelWorker(), MonotonicClock()
    for _ in range(600):  # more than a byte can count
        assert worker.delay_ns(clock, clock.now_ns() + PATIENT_NS) < PATIENT_NS
    worker.close()


def test_a_byte_that_does_not_come_is_waited_for_until_the_end_of_patience() -> None:
    worker, clock = StuckWorker(), MonotonicClock()
    assert worker.delay_ns(clock, clock.now_ns() + LATE_NS) >= LATE_NS
    worker.close()


def test_a_byte_of_an_earlier_look_is_not_taken_for_this_one() -> None:
    worker, clock = StuckWorker(), MonotonicClock()
    worker.delay_ns(clock, clock.now_ns())
    assert worker.hand_on() == b"\x01"
    assert worker.delay_ns(clock, clock.now_ns() + LATE_NS) >= LATE_NS
    assert worker.hand_on() == b"\x02"
    worker.close()
