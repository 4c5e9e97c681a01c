"""One simulated AX-12A: its control table and how it answers packets.

Rules, from ROBOTIS' e-manual and the AX-12 user's manual unless marked:

- PING is answered at any status return level, READ from level 1, the rest at level 2; a broadcast never is.
- A write counts as a whole or not at all. Out of range, read-only, beyond the table, EEPROM while torque is on
  (assumed: the manual only forbids it), or outside 24..35 once LOCK is set: range error. A goal outside the angle
  limits: angle-limit error. ACTION with nothing registered, or a wrong number of parameters: instruction error.
- An unknown instruction is met with silence, a bad checksum addressed to the servo with a checksum error.
- Voltage, overheat and overload bits stand in every reply while their cause lasts. An error that is also set in the
  shutdown register trips the servo: torque limit 0 and torque off; one set in the alarm-LED register makes the LED
  blink. It stays overloaded until torque is enabled again with a torque limit above 0.
- Both angle limits 0 is wheel mode: the goal means nothing, the moving speed is the output, bit 10 its direction.
- A reboot restores the RAM (goal = present, torque limit = max torque, unlocked) and keeps the EEPROM.
- Beyond 0..1023 the potentiometer saturates for `steps.EDGE_TICK` and is open in the rest of the turn: what it reads
  there is erratic (here a function of the angle alone, so that it repeats).

What differs between reports and firmwares is a field of `ServoVariants`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from struct import Struct
from typing import Any, Literal

import numpy as np

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import TICK_RAD, ErrorBit, Register
from armctl.dynamixel.packet import BROADCAST_ID, BadChecksum, Instruction, Packet, encode_status
from armctl.sim import steps
from armctl.sim.drive import DRIVING, Drive, drive_of
from armctl.sim.state import Count, Number, Seat, State

LOCKED_WRITABLE = range(24, 36)
"""Addresses that stay writable after LOCK."""

_READ = int(Instruction.READ)
_ID_AT = ax12a.ID.address
_RETURN_LEVEL_AT = ax12a.RETURN_LEVEL.address
_REGISTERED_AT = ax12a.REGISTERED.address

_ALARMS = Struct("<11x3B4xB")
"""Of the table: temperature limit, lowest and highest voltage; shutdown."""


@dataclass(frozen=True)
class ServoVariants:
    """Behaviour that is unconfirmed on hardware; the defaults are the ones that surprise a careless program."""

    goal_write_energises: bool = True
    """Writing a goal to a limp servo switches its torque on."""
    speed_write_energises: bool = True
    """Writing a moving speed to a limp servo switches its torque on."""
    goal_follows_when_limp: bool = True
    """The goal register follows the position while torque is off; otherwise it keeps the old goal."""
    ramp_from_reference: bool = True
    """A new goal continues the speed ramp from the reference in force; otherwise from the present position."""


class SimulatedServo(Seat):
    """Registers, instructions and error bits of one AX-12A; the arm's physics moves it."""

    velocity_rad_s = Number(steps.OMEGA)
    output = Number(steps.OUTPUT)
    """Motor output, -1..1, CCW positive."""
    voltage_V, temperature_degC = Number(steps.SERVO_V), Number(steps.DEGC)
    overloaded = Count(steps.OVERLOADED)
    booting = Count(steps.BOOTING)
    """Deaf and mute: its firmware has not started yet."""

    def __init__(
        self,
        servo_id: int,
        rng: np.random.Generator,
        seat: tuple[State, int] | None = None,
        *,
        position_tick: float = 512.0,
        noise_tick: float = 0.0,
        draws_at_once: int = 64,
        variants: ServoVariants = ServoVariants(),
    ) -> None:
        """A servo just powered up, with the factory's registers except its id.

        Args:
            seat: The arm's state and its place in it; None: no arm moves this servo.
            noise_tick: Standard deviation of the reported position.
            draws_at_once: How many numbers of `rng` are drawn ahead for it; 1 if others draw from it too.
        """
        super().__init__(*(seat or (State(1), 0)))
        self.table = bytearray(ax12a.TABLE_SIZE)
        """The control table; what is measured is brought up to date by whoever asks for it."""
        self._view: Any = np.frombuffer(self.table, np.uint8)
        self._draws = _standard_normals(rng, draws_at_once)
        self.noise: float | None = None
        """Noise of every position reading, in standard deviations; None: each reading has its own."""
        self._noise_tick = noise_tick
        self._variants = variants
        self.counts[self.of + steps.FOLLOWS] = variants.goal_follows_when_limp
        self._registered: tuple[int, bytes] | None = None
        self.position_tick = self.reference_tick = position_tick
        self.voltage_V, self.temperature_degC = 12.0, 30.0
        self.frozen_tick = None
        self._last_error = 0
        self._driven_by: tuple[int, ...] = ()
        self._drive: Drive
        self.writes = 0
        """Counts whatever may change `drive`."""
        self._restore_factory_table()
        self.set(ax12a.ID, servo_id)

    # ------------------------------------------------------------------------------------------ registers

    def get(self, register: Register) -> int:
        """Value of a register, as a READ would report it but without noise."""
        if not register.eeprom:
            self._refresh(0.0)
        return self._value(register)

    def values(self, *registers: Register) -> tuple[int, ...]:
        """What `get` says of several registers of the RAM, all at one instant."""
        self._refresh(0.0)
        return tuple(map(self._value, registers))

    def set(self, register: Register, value: int) -> None:
        """Put a value into the table without any check or effect: the factory's or a wizard's hand."""
        self._put(register.address, value.to_bytes(register.size, "little"))

    def _put(self, address: int, data: bytes) -> None:
        counts = self.counts
        self.table[address : address + len(data)] = data
        self.writes += 1
        counts[steps.TOLD] = 1
        if address < ax12a.EEPROM_END:
            counts[steps.EEPROM_WRITES] += 1
            for place, limit in enumerate(_ALARMS.unpack_from(self.table), self.of + steps.MAX_DEGC):
                counts[place] = limit

    @property
    def position_tick(self) -> float:
        """Output shaft as its potentiometer sees it, before quantisation and noise."""
        return self.numbers[self.at + steps.SHAFT] / TICK_RAD

    @position_tick.setter
    def position_tick(self, value: float) -> None:
        self.numbers[self.at + steps.SHAFT] = value * TICK_RAD

    @property
    def reference_tick(self) -> float:
        """Where the speed ramp stands."""
        return self.numbers[self.at + steps.REFERENCE]

    @reference_tick.setter
    def reference_tick(self, value: float) -> None:
        if value != self.numbers[self.at + steps.REFERENCE]:
            self.numbers[self.at + steps.REFERENCE] = value
            self.counts[self.of + steps.FRESH] = 1

    @property
    def frozen_tick(self) -> int | None:
        """What a frozen position sensor reads; None: it works."""
        tick = self.counts[self.of + steps.FROZEN]
        return None if tick < 0 else tick

    @frozen_tick.setter
    def frozen_tick(self, value: int | None) -> None:
        self.counts[self.of + steps.FROZEN] = -1 if value is None else value

    @property
    def servo_id(self) -> int:
        return self.table[_ID_AT]

    @property
    def torque_enabled(self) -> bool:
        return bool(self.table[ax12a.TORQUE_ENABLE.address])

    @property
    def wheel_mode(self) -> bool:
        return self._value(ax12a.CW_LIMIT) == 0 == self._value(ax12a.CCW_LIMIT)

    @property
    def baud(self) -> float:
        return 2e6 / (self.table[ax12a.BAUD.address] + 1)

    @property
    def return_delay_ns(self) -> int:
        return self.table[ax12a.RETURN_DELAY.address] * 2000

    @property
    def led(self) -> Literal["off", "on", "blinking"]:
        """The light on its case: blinking for an alarm the alarm-LED register asks for, else as its register says."""
        if (self._alarms() | self._last_error) & self._value(ax12a.ALARM_LED):
            return "blinking"
        return "on" if self._value(ax12a.LED) else "off"

    @property
    def drive(self) -> Drive:
        """The position controller's settings now."""
        registers = DRIVING.unpack(self.table)
        if registers != self._driven_by:
            self._driven_by, self._drive = registers, drive_of(*registers)
        return self._drive

    def _value(self, register: Register) -> int:
        table, at = self.table, register.address
        return table[at] | table[at + 1] << 8 if register.size == 2 else table[at]

    def _quantised_tick(self) -> int:
        frozen = self.frozen_tick
        return steps.sensed_tick(self.position_tick) if frozen is None else frozen

    def freeze(self) -> None:
        """Let the position sensor read for ever what it reads now; `frozen_tick = None` mends it."""
        self.frozen_tick = self._quantised_tick()

    def _refresh(self, noise_tick: float) -> int:
        """Bring the measured registers up to date; the error bits that stand."""
        if steps.machine_code:
            numbers, counts, _ = self.state.views
            return steps.measure(numbers, counts, self._view, self.i, noise_tick)
        return steps.measure(self.numbers, self.counts, self.table, self.i, noise_tick)

    # --------------------------------------------------------------------------------------- instructions

    def handle(self, packet: Packet | BadChecksum) -> bytes | None:
        """React to a packet on the bus; the status packet sent back, or None for silence."""
        table, to = self.table, packet.servo_id
        servo_id, level = table[_ID_AT], table[_RETURN_LEVEL_AT]
        if to not in (servo_id, BROADCAST_ID):
            return None
        reply = b""
        if isinstance(packet, Packet):
            code = packet.code
            if code == _READ:  # most of them by far
                error, reply = self._read(packet.parameters)
            elif (react := _REACTIONS.get(code)) is None:
                return None
            else:
                error, reply = react(self, packet.parameters)
                error |= self._alarms()
        elif to == BROADCAST_ID:
            return None
        else:
            code, error = -1, ErrorBit.CHECKSUM | self._alarms()
        self._last_error = error
        if error:
            self._shut_down(error)
        if to == BROADCAST_ID or not (level == 2 or code == Instruction.PING or (level and code == _READ)):
            return None
        return encode_status(servo_id, error, reply)

    def _read(self, parameters: bytes) -> tuple[int, bytes]:
        """Every error bit, those that stand included, and the bytes asked for."""
        if len(parameters) != 2:
            return ErrorBit.INSTRUCTION | self._alarms(), b""
        begin, size = parameters
        if size == 0 or begin + size > ax12a.TABLE_SIZE:
            return ErrorBit.RANGE | self._alarms(), b""
        noise = 0.0
        if self._noise_tick:
            noise = self._noise_tick * (next(self._draws) if self.noise is None else self.noise)
        return self._refresh(noise), bytes(self.table[begin : begin + size])

    def _told(self, parameters: bytes) -> tuple[int, bytes]:
        return self._write(parameters[:1], parameters[1:]), b""

    def _write(self, address: bytes, data: bytes) -> int:
        error = self._refusal(address, data)
        if not error:
            self._apply(address[0], data)
        return error

    def _register_write(self, parameters: bytes) -> tuple[int, bytes]:
        address, data = parameters[:1], parameters[1:]
        error = self._refusal(address, data)
        if not error:
            self._registered = (address[0], data)
            self.table[_REGISTERED_AT] = 1
        return error, b""

    def _action(self, _: bytes) -> tuple[int, bytes]:
        if self._registered is None:
            return ErrorBit.INSTRUCTION, b""
        address, data = self._registered
        self._registered = None
        self.table[_REGISTERED_AT] = 0
        return self._write(bytes((address,)), data), b""

    def _reset(self, _: bytes) -> tuple[int, bytes]:
        self._restore_factory_table()
        return 0, b""

    def _sync_write(self, parameters: bytes) -> tuple[int, bytes]:
        size = parameters[1] + 1 if len(parameters) > 1 else 0
        if size < 2 or (len(parameters) - 2) % size:
            return ErrorBit.INSTRUCTION, b""
        error, servo_id = 0, self.table[_ID_AT]
        for begin in range(2, len(parameters), size):
            if parameters[begin] == servo_id:
                error |= self._write(parameters[:1], parameters[begin + 1 : begin + size])
        return error, b""

    def _refusal(self, address: bytes, data: bytes) -> int:
        """Why this write must not happen."""
        if not data:
            return ErrorBit.INSTRUCTION
        begin, end = address[0], address[0] + len(data)
        if end > ax12a.TABLE_SIZE:
            return ErrorBit.RANGE
        locked = bool(self.table[ax12a.LOCK.address])
        if locked and not (begin in LOCKED_WRITABLE and end - 1 in LOCKED_WRITABLE):
            return ErrorBit.RANGE
        after = bytearray(self.table)
        after[begin:end] = data
        error, wheel = 0, self.wheel_mode
        for register in _touched(begin, end).values():
            value = int.from_bytes(after[register.address : register.address + register.size], "little")
            highest = ax12a.TICK_MAX if register is ax12a.MOVING_SPEED and not wheel else register.maximum
            if (
                not register.writable
                or not register.minimum <= value <= highest
                or (register.eeprom and self.torque_enabled)
            ):
                error |= int(ErrorBit.RANGE)
            elif register is ax12a.GOAL and not wheel:
                low, high = self._value(ax12a.CW_LIMIT), self._value(ax12a.CCW_LIMIT)
                if not low <= value <= high:
                    error |= int(ErrorBit.ANGLE_LIMIT)
        return error

    def _apply(self, address: int, data: bytes) -> None:
        touched = _touched(address, address + len(data))
        was_enabled = self.torque_enabled
        if not was_enabled:
            self._refresh(0.0)  # a goal that followed the position is where it is now
        self._put(address, data)
        energising = (ax12a.GOAL.name in touched and self._variants.goal_write_energises) or (
            ax12a.MOVING_SPEED.name in touched and self._variants.speed_write_energises
        )
        if energising and ax12a.TORQUE_ENABLE.name not in touched:
            self.table[ax12a.TORQUE_ENABLE.address] = 1
        if not self.torque_enabled:
            self.output = 0.0
        elif not was_enabled:
            self.reference_tick = self._quantised_tick()
            if self._value(ax12a.TORQUE_LIMIT) > 0:
                self.overloaded = 0
        elif ax12a.GOAL.name in touched and not self._variants.ramp_from_reference:
            self.reference_tick = self._quantised_tick()

    def _restore_factory_table(self) -> None:
        for register in ax12a.REGISTERS:
            if register.eeprom:
                self.set(register, register.default)
        self.reboot()

    def reboot(self) -> None:
        """Restart the firmware: the RAM forgets, the EEPROM stays, the torque is off."""
        for register in ax12a.REGISTERS:
            if not register.eeprom:
                self.set(register, register.default)
        self.set(ax12a.GOAL, self._quantised_tick())
        self.set(ax12a.TORQUE_LIMIT, self._value(ax12a.MAX_TORQUE))
        self._registered = None
        self._last_error = 0
        self.overloaded = 0
        self.output = 0.0

    # --------------------------------------------------------------------------------------------- alarms

    def _alarms(self) -> int:
        """Error bits that stand."""
        numbers, counts, _ = self.state.views if steps.machine_code else self.state.plain
        return steps.alarms(numbers, counts, self.at, self.of)

    def protect(self, *, overloaded: bool = False) -> None:
        """Note an overload, and shut down if an alarm that stands is also in the shutdown register."""
        self.overloaded |= overloaded
        if error := self._alarms():
            self._shut_down(error)

    def _shut_down(self, error: int) -> None:
        if self.torque_enabled and error & self._value(ax12a.SHUTDOWN):
            self.set(ax12a.TORQUE_LIMIT, 0)
            self.set(ax12a.TORQUE_ENABLE, 0)
            self.output = 0.0


_REACTIONS: dict[int, Callable[[SimulatedServo, bytes], tuple[int, bytes]]] = {
    Instruction.PING: lambda _servo, _parameters: (0, b""),
    Instruction.WRITE: SimulatedServo._told,
    Instruction.REG_WRITE: SimulatedServo._register_write,
    Instruction.ACTION: SimulatedServo._action,
    Instruction.RESET: SimulatedServo._reset,
    Instruction.SYNC_WRITE: SimulatedServo._sync_write,
}
"""What each instruction but READ does with its parameters: the error bits of the request, the bytes of the reply."""


def _standard_normals(rng: np.random.Generator, at_once: int) -> Iterator[float]:
    """The same numbers as one draw after another; a draw by itself costs more than what it is for."""
    while True:
        yield from rng.standard_normal(at_once).tolist()


@cache
def _touched(begin: int, end: int) -> dict[str, Register]:
    """Registers that overlap the addresses begin..end-1, by name."""
    return {r.name: r for r in ax12a.REGISTERS if r.address < end and r.address + r.size > begin}
