"""Byte sequences against the two readers of replies: the packet decoder, and the bus with the SDK's parser below it.

Claims, for any bytes:

1. Neither raises nor hangs.
2. The decoder's packets depend on the bytes and not on how they were cut, at whichever byte.
3. What the decoder calls a packet stands in the stream, in order and without overlap, and after a `reset` the next
   good packet is found.
4. The bus believes a reply only if the stream holds a good status packet of the servo asked, of the length asked for.
"""

from __future__ import annotations

import itertools
import logging
import multiprocessing
import os
import queue
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from armctl.clock import VirtualClock
from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import IMPOSSIBLE_BITS
from armctl.dynamixel.bus import ServoBus
from armctl.dynamixel.packet import (
    BROADCAST_ID,
    BadChecksum,
    Decoder,
    Instruction,
    Packet,
    encode_instruction,
    encode_status,
)
from armctl.dynamixel.port import ServoPort

RUNS = 5_000_000
SHARD_RUNS = 25_000
SHARD_TIMEOUT_S = 120.0
# One in so many sequences also goes to the bus, which takes longer over it.
BUS_EVERY = 25
LONGEST = 48
# Violations told in words.
KEPT = 10
PROBE = encode_status(7, 0, b"\x20\x01")
SERVO_ID = 1


@dataclass
class Tally:
    """What a shard found."""

    decoder_runs: int = 0
    bus_runs: int = 0
    packets: int = 0
    bad_checksums: int = 0
    believed: int = 0
    violations: int = 0
    examples: list[str] = field(default_factory=list)

    def violation(self, claim: str, stream: bytes) -> None:
        self.violations += 1
        if len(self.examples) < KEPT:
            self.examples.append(f"{claim}: {stream.hex()}")

    def add(self, other: Tally) -> None:
        for name in ("decoder_runs", "bus_runs", "packets", "bad_checksums", "believed", "violations"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.examples = (self.examples + other.examples)[:KEPT]


def prove(seed: int, runs: int = RUNS) -> dict[str, Any]:
    """Judge `runs` byte sequences in worker processes; a worker that stops reporting counts as a hang."""
    shards = [(seed, index, min(SHARD_RUNS, runs - begin)) for index, begin in enumerate(range(0, runs, SHARD_RUNS))]
    total = Tally()
    context = multiprocessing.get_context("spawn")
    results: multiprocessing.Queue[Tally] = context.Queue()
    workers = os.cpu_count() or 1
    processes = [
        context.Process(target=_work, args=(shards[worker::workers], results), daemon=True)
        for worker in range(min(workers, len(shards)))
    ]
    for process in processes:
        process.start()
    try:
        for _ in shards:
            total.add(results.get(timeout=SHARD_TIMEOUT_S))
    except queue.Empty:
        total.violation(f"hang: no shard done for {SHARD_TIMEOUT_S:g} s", b"")
    finally:
        for process in processes:
            process.terminate()
            process.join()
    return {
        "runs": total.decoder_runs,
        "violations": total.violations,
        "examples": total.examples,
        "bus_runs": total.bus_runs,
        "packets": total.packets,
        "bad_checksums": total.bad_checksums,
        "believed": total.believed,
        "seed": seed,
    }


def _work(shards: list[tuple[int, int, int]], results: multiprocessing.Queue[Tally]) -> None:
    logging.disable(logging.CRITICAL)  # the bus tells every change of error bits
    for shard in shards:
        results.put(fuzz(*shard))


def fuzz(seed: int, shard: int, runs: int) -> Tally:
    """Judge `runs` byte sequences of one shard in this process."""
    tally = Tally()
    rng = np.random.default_rng((seed, shard))
    line = _FixedLine()
    bus = ServoBus(line, (SERVO_ID,))
    bus.open()
    for index, stream in enumerate(itertools.islice(sequences(rng), runs)):
        _judge_decoder(stream, index, tally)
        if index % BUS_EVERY == 0:
            _judge_bus(bus, line, stream, tally)
    return tally


def sequences(rng: np.random.Generator) -> Iterator[bytes]:
    """Byte sequences without end: plain noise, noise that looks like headers, and good packets damaged."""
    alphabet = np.array([0xFF, 0xFF, 0xFF, 0, 1, 2, 3, 4, 5, 6, 7, 0xFD, 0xFE], dtype=np.uint8)
    while True:
        lengths = rng.integers(0, LONGEST + 1, 3000)
        noise = rng.bytes(1000 * LONGEST)
        headers = alphabet[rng.integers(0, len(alphabet), 2000 * LONGEST)].tobytes()
        cuts = rng.integers(0, 1 << 30, (1000, 4)).tolist()
        for i in range(1000):
            begin = i * LONGEST
            yield noise[begin : begin + lengths[3 * i]]
            yield headers[2 * begin : 2 * begin + lengths[3 * i + 1]]
            yield _damaged(cuts[i], noise[begin : begin + LONGEST])


def _damaged(draw: list[int], noise: bytes) -> bytes:
    """One to three packets with one thing wrong, or nothing."""
    count, kind, at, bit = draw
    stream = b""
    for packet in range(1 + count % 3):
        servo_id = SERVO_ID if (count >> packet + 4) & 1 else noise[packet] % (BROADCAST_ID - 1)
        data = _status_block(noise) if (count >> packet + 8) & 1 else noise[10 : 10 + noise[packet + 3] % 12]
        stream += encode_status(servo_id, noise[packet + 6] & 0x7F, data)
    at %= len(stream)
    match kind % 6:
        case 0:
            return stream[:at] + bytes((stream[at] ^ (1 << bit % 8),)) + stream[at + 1 :]
        case 1:
            return stream[:at] + stream[at + 1 + bit % 4 :]
        case 2:
            return stream[:at] + noise[: 1 + bit % 6] + stream[at:]
        case 3:
            return stream[:at] + stream
        case 4:
            return stream[:at]
        case _:
            return stream


def _status_block(noise: bytes) -> bytes:
    """Bytes 24..49 that a servo standing still could send."""
    at = ax12a.PRESENT_POSITION.address - ax12a.STATUS_BEGIN
    possible = int.from_bytes(noise[10 : 10 + ax12a.STATUS_SIZE], "little") & ~IMPOSSIBLE_BITS
    block = possible.to_bytes(ax12a.STATUS_SIZE, "little")
    return block[:at] + b"\x00\x02" + block[at + 2 :]


def _judge_decoder(stream: bytes, index: int, tally: Tally) -> None:
    tally.decoder_runs += 1
    try:
        decoder = Decoder()
        whole = decoder.feed(stream)
        decoder.reset()
        probed = decoder.feed(PROBE)
        split = Decoder()
        by_byte = [found for i in range(len(stream)) for found in split.feed(stream[i : i + 1])]
        cut = index % (len(stream) + 1)
        halves = Decoder()
        in_two = halves.feed(stream[:cut]) + halves.feed(stream[cut:])
    except Exception as error:  # any exception at all is what this looks for
        tally.violation(f"decoder raised {error!r}", stream)
        return
    if by_byte != whole or in_two != whole:
        tally.violation("the cut changes the packets", stream)
    if probed != [Packet(7, 0, b"\x20\x01")]:
        tally.violation("a good packet is lost after a reset", stream)
    end = 0
    for found in whole:
        if isinstance(found, BadChecksum):
            tally.bad_checksums += 1
            raw = found.raw
            if stream.find(raw) < 0:
                tally.violation("a bad checksum that is not in the stream", stream)
            continue
        tally.packets += 1
        raw = encode_instruction(found.servo_id, found.code, found.parameters)
        at = stream.find(raw, end)
        if at < 0:
            tally.violation("a packet that is not in the stream", stream)
        end = at + len(raw)


def _judge_bus(bus: ServoBus, line: _FixedLine, stream: bytes, tally: Tally) -> None:
    tally.bus_runs += 1
    line.answer = stream
    begin_ns = line.clock.now_ns()
    try:
        sample = bus.read_sample()
    except Exception as error:  # any exception at all is what this looks for
        tally.violation(f"bus raised {error!r}", stream)
        return
    took_ms = (line.clock.now_ns() - begin_ns) / 1e6
    if took_ms > 60.0:
        tally.violation(f"the bus took {took_ms:.0f} ms of virtual time over one servo", stream)
    reading = sample.servos[0]
    if reading.fresh:
        tally.believed += 1
        if encode_status(SERVO_ID, reading.error, reading.registers) not in stream:
            tally.violation("the bus believed what is not in the stream", stream)


class _FixedLine(ServoPort):
    """A line that answers every status read with the same bytes, in virtual time."""

    def __init__(self) -> None:
        super().__init__("fixed", 1_000_000, VirtualClock())
        self.answer = b""

    def openPort(self) -> bool:
        self.is_open = True
        return True

    def closePort(self) -> None:
        self.is_open = False

    def getBytesAvailable(self) -> int:
        return len(self._received)

    def _send(self, packet: bytes) -> int:
        self._received = self.answer if packet[4] == Instruction.READ else b""
        return len(packet)

    def readPort(self, length: int) -> bytes:
        data = super().readPort(length)
        if len(data) == length:  # what is missing, `_fill` has waited for
            self.clock.sleep_until_ns(self.clock.now_ns() + length * self.byte_ns)
        return data

    def _fill(self, length: int) -> None:
        self.clock.sleep_until_ns(self._deadline_ns)

    def _discard(self) -> None:
        pass  # `clearPort` has emptied what was left
