"""One bus cycle of six servos, armctl's beside others' in the same run: its time, and its CPU.

A cycle is one READ a servo and one SYNC_WRITE of goal and speed; its wire time is what 1 Mbps and the servos' return
delay allow. All clients drive the same simulator, a process of its own that paces every byte, so a figure holds the
machine's and the simulator's part too (a simulator held up for milliseconds is a reply missed). So the ratio to `raw`
is bounded, which does nothing but os.write, select and os.read, and believes whatever comes. pypot may lose its
SYNC_WRITE to its own flush and look faster. CPU is user and system time of the client's process.
"""

import os
import resource
import select
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dynamixel_sdk
import serial

from armctl.clock import MonotonicClock
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import ServoBus
from armctl.dynamixel.packet import BITS_PER_BYTE, BROADCAST_ID, Instruction, encode_instruction
from armctl.dynamixel.serial_port import SerialPort
from armctl.files import load_arm
from armctl.lab.demo import started
from armctl.messages import Goal
from proving.figures import check, row
from proving.rig import ARM

BAUD = 1_000_000
RETURN_DELAYS_US = (0, 500)
CYCLES = 150
# Each client runs so often, in turn; the best round counts, being the one least disturbed by other work.
ROUNDS = 5
WARM_UP = 20
SERVOS = 6
SHORT_READ = (ax12a.PRESENT_POSITION.address, 8)
FULL_READ = (ax12a.STATUS_BEGIN, ax12a.STATUS_SIZE)
PYPOT_READ_SIZE = 6
SYNC_WRITE_SIZE = 4
OURS, RAW = "armctl, full status", "raw, full status"
CYCLE_BOUND = 1.10
# Both to the raw client of the same run.
CPU_BOUND = 2.0

# Does one cycle; returns the number of replies missed in it.
Cycle = Callable[[], int]


@dataclass(frozen=True)
class _Client:
    who: str
    read_size: int
    write_size: int
    cycle: Cycle
    close: Callable[[], None]


@dataclass
class _Figure:
    cycle_us: float = float("inf")
    cpu_us: float = float("inf")
    missed: int = 0
    replies: int = 0


def bench(seed: int, cycles: int = CYCLES, rounds: int = ROUNDS) -> dict[str, Any]:
    """Rows and checks; `ratio` is to the wire time (cycle) or to the raw client's full status (CPU)."""
    rows: list[dict[str, Any]] = []
    checks: list[dict[str, Any]] = []
    for delay_us in RETURN_DELAYS_US:
        figures = _measure(seed, delay_us, cycles, rounds)
        (ours, _), (raw, _) = figures[OURS], figures[RAW]
        for who, (figure, wire_us) in figures.items():
            work = f"cycle, return delay {delay_us} us"
            rows.append(row(work, who, figure.cycle_us / 1e3, "ms", figure.cycle_us / wire_us))
            rows.append(row(f"CPU of a {work}", who, figure.cpu_us / 1e3, "ms", figure.cpu_us / raw.cpu_us))
            if figure.missed:
                rows.append(row(f"replies missed, {work}", who, figure.missed, "", figure.missed / figure.replies))
        checks += [
            check(f"cycle / raw at {delay_us} us", ours.cycle_us / raw.cycle_us, CYCLE_BOUND),
            check(f"CPU / raw at {delay_us} us", ours.cpu_us / raw.cpu_us, CPU_BOUND),
        ]
    return {"rows": rows, "checks": checks, "seed": seed}


def wire_time_us(servos: int, read_size: int, write_size: int, delay_us: int) -> float:
    """Least time of a cycle: every byte at 1 Mbps, and a return delay a read."""
    byte_us = BITS_PER_BYTE * 1e6 / BAUD
    read_bytes = 8 + 6 + read_size
    write_bytes = 8 + servos * (1 + write_size) if write_size else 0
    return servos * (read_bytes * byte_us + delay_us) + write_bytes * byte_us


def _measure(seed: int, delay_us: int, cycles: int, rounds: int) -> dict[str, tuple[_Figure, float]]:
    servo_ids = load_arm(ARM).servo_ids
    figures: dict[str, tuple[_Figure, float]] = {}
    with tempfile.TemporaryDirectory(prefix="armctl-") as name:
        port = Path(name) / "servos"
        options = ("--link", str(port), "--seed", str(seed), "--return-delay-us", str(delay_us))
        with started(Path(name) / "simulator.log", "sim", *options):
            goal = _still(str(port), servo_ids)
            for _ in range(rounds):
                for make in (_armctl, _raw_full, _armctl_short, _raw_short, _sdk_full, _sdk_short, _pypot):
                    client = make(str(port), servo_ids, goal)
                    wire_us = wire_time_us(len(servo_ids), client.read_size, client.write_size, delay_us)
                    figure, _ = figures.setdefault(client.who, (_Figure(), wire_us))
                    try:
                        _time(client.cycle, cycles, figure)
                    finally:
                        client.close()
    return figures


def _time(cycle: Cycle, cycles: int, figure: _Figure) -> None:
    for _ in range(WARM_UP):
        cycle()
    used, begin_ns = resource.getrusage(resource.RUSAGE_SELF), time.monotonic_ns()
    missed = sum(cycle() for _ in range(cycles))
    took_ns, now = time.monotonic_ns() - begin_ns, resource.getrusage(resource.RUSAGE_SELF)
    cpu_s = now.ru_utime - used.ru_utime + now.ru_stime - used.ru_stime
    figure.cycle_us = min(figure.cycle_us, took_ns / 1e3 / cycles)
    figure.cpu_us = min(figure.cpu_us, 1e6 * cpu_s / cycles)
    figure.missed += missed
    figure.replies += cycles * SERVOS


def _still(port: str, servo_ids: tuple[int, ...]) -> Goal:
    """The goals that leave the arm where it is; the arm leans on its rest and is limp to begin with."""
    clock = MonotonicClock()
    bus = ServoBus(SerialPort(port, BAUD, clock), servo_ids)
    bus.open()
    ticks = [bus.read(servo_id, ax12a.PRESENT_POSITION) for servo_id in servo_ids]
    bus.close()
    return Goal(tuple(tick or 0 for tick in ticks), (100,) * len(servo_ids))


def _armctl(port: str, servo_ids: tuple[int, ...], goal: Goal) -> _Client:
    clock = MonotonicClock()
    bus = ServoBus(SerialPort(port, BAUD, clock), servo_ids)
    bus.open()

    def cycle() -> int:
        sample = bus.read_sample()
        bus.write_goal(goal)
        return sample.retries

    return _Client(OURS, ax12a.STATUS_SIZE, SYNC_WRITE_SIZE, cycle, bus.close)


def _armctl_short(port: str, servo_ids: tuple[int, ...], goal: Goal) -> _Client:
    handler = SerialPort(port, BAUD, MonotonicClock())
    handler.openPort()
    return _sdk("dynamixel-sdk on armctl's port, 8 bytes", handler, servo_ids, goal, SHORT_READ)


def _sdk_full(port: str, servo_ids: tuple[int, ...], goal: Goal) -> _Client:
    return _sdk("dynamixel-sdk, full status", _stock_port(port), servo_ids, goal, FULL_READ)


def _sdk_short(port: str, servo_ids: tuple[int, ...], goal: Goal) -> _Client:
    return _sdk("dynamixel-sdk, 8 bytes", _stock_port(port), servo_ids, goal, SHORT_READ)


def _stock_port(port: str) -> dynamixel_sdk.PortHandler:
    handler = dynamixel_sdk.PortHandler(port)
    assert handler.setBaudRate(BAUD)  # opens it
    return handler


def _sdk(who: str, handler: Any, servo_ids: tuple[int, ...], goal: Goal, read: tuple[int, int]) -> _Client:
    packets = dynamixel_sdk.PacketHandler(1.0)
    writer = dynamixel_sdk.GroupSyncWrite(handler, packets, ax12a.GOAL.address, SYNC_WRITE_SIZE)

    def cycle() -> int:
        missed = 0
        for servo_id in servo_ids:
            data, result, _ = packets.readTxRx(handler, servo_id, *read)
            missed += (len(data), result) != (read[1], dynamixel_sdk.COMM_SUCCESS)
        writer.clearParam()
        for servo_id, tick, speed in zip(servo_ids, goal.ticks, goal.speeds, strict=True):
            writer.addParam(servo_id, [*tick.to_bytes(2, "little"), *speed.to_bytes(2, "little")])
        writer.txPacket()
        return missed

    return _Client(who, read[1], SYNC_WRITE_SIZE, cycle, handler.closePort)


def _raw_full(port: str, servo_ids: tuple[int, ...], goal: Goal) -> _Client:
    return _raw(RAW, port, servo_ids, goal, FULL_READ)


def _raw_short(port: str, servo_ids: tuple[int, ...], goal: Goal) -> _Client:
    return _raw("raw, 8 bytes", port, servo_ids, goal, SHORT_READ)


def _raw(who: str, port: str, servo_ids: tuple[int, ...], goal: Goal, read: tuple[int, int]) -> _Client:
    line = serial.Serial(port, BAUD, timeout=0)
    descriptor = line.fileno()
    requests = [encode_instruction(servo_id, Instruction.READ, bytes(read)) for servo_id in servo_ids]
    data = bytes((ax12a.GOAL.address, SYNC_WRITE_SIZE))
    for servo_id, tick, speed in zip(servo_ids, goal.ticks, goal.speeds, strict=True):
        data += bytes((servo_id,)) + tick.to_bytes(2, "little") + speed.to_bytes(2, "little")
    sync_write = encode_instruction(BROADCAST_ID, Instruction.SYNC_WRITE, data)
    size = 6 + read[1]

    def cycle() -> int:
        for request in requests:
            os.write(descriptor, request)
            left = size
            while left:
                assert select.select([descriptor], [], [], 0.1)[0]
                left -= len(os.read(descriptor, left))
        os.write(descriptor, sync_write)
        return 0

    return _Client(who, read[1], SYNC_WRITE_SIZE, cycle, line.close)


def _pypot(port: str, servo_ids: tuple[int, ...], goal: Goal) -> _Client:
    """pypot reads six bytes where it reads position, speed and load; it knows degrees only."""
    from pypot.dynamixel import DxlIO

    io = DxlIO(port, baudrate=BAUD)
    degrees = {
        servo_id: (300.0 * tick / ax12a.TICK_MAX - 150.0, 66.0, 100.0)
        for servo_id, tick in zip(servo_ids, goal.ticks, strict=True)
    }

    def cycle() -> int:
        missed = len(servo_ids) - len(io.get_present_position_speed_load(servo_ids))
        io.set_goal_position_speed_load(degrees)
        return missed

    return _Client("pypot, 6 bytes", PYPOT_READ_SIZE, 6, cycle, io.close)
