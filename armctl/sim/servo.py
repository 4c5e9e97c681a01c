"""One simulated AX-12A: its control table and how it answers packets.

Rules, from ROBOTIS' e-manual and the AX-12 user's manual unless marked:

- PING is answered at any status return level, READ from level 1, the rest at level 2; a broadcast never is (a switch).
- A write counts as a whole or not at all. Out of range, read-only, beyond the table, EEPROM while torque is on
  (assumed: the manual only forbids it), or outside 24..35 once LOCK is set: range error. A goal outside the angle
  limits: angle-limit error. ACTION with nothing registered, or a wrong number of parameters: instruction error.
- An unknown instruction is met with silence (a switch), a bad checksum addressed to the servo with a checksum error.
- Voltage, overheat and overload bits stand in every reply while their cause lasts. An error that is also set in the
  shutdown register trips the servo: torque limit 0 and torque off; one set in the alarm-LED register makes the LED
  blink. It stays overloaded until torque is enabled again with a torque limit above 0.
- Both angle limits 0 is wheel mode: the goal means nothing, the moving speed is the output, bit 10 its direction.
- A reboot restores the RAM (goal = present, torque limit = max torque, unlocked) and keeps the EEPROM.
- Beyond 0..1023 the potentiometer saturates and is open in the rest of the turn, see `potentiometer.py`.

What differs between reports and firmwares is a field of `ServoVariants`.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from struct import Struct
from typing import Literal

import numpy as np

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import LOAD_MAX, SPEED_UNIT_RAD_S, TICK_RAD, ErrorBit, Register
from armctl.dynamixel.packet import BROADCAST_ID, BadChecksum, Instruction, Packet, encode_status
from armctl.sim.control_table import refusal, touched, value
from armctl.sim.drive import DRIVING, Drive, drive_of
from armctl.sim.potentiometer import sensed_tick

_READ = int(Instruction.READ)
_ID_AT = ax12a.ID.address
_RETURN_LEVEL_AT = ax12a.RETURN_LEVEL.address
_REGISTERED_AT = ax12a.REGISTERED.address

_TORQUE_ENABLE_AT, _GOAL_AT, _MOVING_AT = ax12a.TORQUE_ENABLE.address, ax12a.GOAL.address, ax12a.MOVING.address
_GOAL = Struct("<H")
_MEASURED_AT = ax12a.PRESENT_POSITION.address
# Position, speed, load, voltage and temperature, which follow one another in the table.
_MEASURED = Struct("<3H2B")
# Of the table: temperature limit, lowest and highest voltage.
_ALARM_LIMITS = Struct("<11x3B")
# Plain numbers: operations on flags take ten times longer, and every reading looks at the alarms.
_VOLTAGE, _OVERHEAT, _OVERLOAD = int(ErrorBit.VOLTAGE), int(ErrorBit.OVERHEAT), int(ErrorBit.OVERLOAD)

# Numbers for the noise that are drawn ahead.
DRAWS_AT_ONCE = 64


@dataclass(frozen=True)
class ServoVariants:
    """Behaviour that is unconfirmed on hardware; the defaults are the ones that surprise a careless program."""

    # Writing a goal to a limp servo switches its torque on.
    goal_write_energises: bool = True
    # Writing a moving speed to a limp servo switches its torque on.
    speed_write_energises: bool = True
    # The goal register follows the position while torque is off; otherwise it keeps the old goal.
    goal_follows_when_limp: bool = True
    # A new goal continues the speed ramp from the reference in force; otherwise from the present position.
    ramp_from_reference: bool = True
    # A broadcast PING is answered, by all servos at once (the manual of 2006 says both).
    broadcast_ping_answered: bool = False
    # An instruction that no manual defines is answered with the error bit that exists for it.
    unknown_instruction_answered: bool = False
    # In wheel mode a goal is refused with an angle-limit error.
    wheel_goal_refused: bool = False
    # For so long after an alarm is over the LED goes on blinking; the manual says 2 s.
    led_lingers_s: float = 0.0


class SimulatedServo:
    """Registers, instructions and error bits of one AX-12A; the arm's physics (`joint.py`) moves its shaft."""

    def __init__(
        self,
        servo_id: int,
        rng: np.random.Generator,
        *,
        position_tick: float = 512.0,
        noise_tick: float = 0.0,
        variants: ServoVariants = ServoVariants(),
    ) -> None:
        """A servo just powered up, with the factory's registers except its id.

        Args:
            rng: Its own; nobody else may draw from it, since its numbers are drawn ahead.
            noise_tick: Standard deviation of the reported position.
        """
        # The control table; what is measured is brought up to date by whoever asks for it.
        self.table = bytearray(ax12a.TABLE_SIZE)
        # Angle of the output shaft; position 0 of the table is 0.
        self.shaft_rad = position_tick * TICK_RAD
        self.velocity_rad_s = 0.0
        # Motor output, -1..1, CCW positive.
        self.output = 0.0
        # Where the speed ramp is.
        self.reference_tick = position_tick
        self.voltage_V, self.temperature_degC = 12.0, 30.0
        # What a frozen position sensor reads; None: it works.
        self.frozen_tick: int | None = None
        self.overloaded = False
        # Deaf and mute: its firmware has not started yet.
        self.booting = False
        # Noise of every position reading, in standard deviations; None: each reading has its own.
        self.noise: float | None = None
        # Counts whatever may change `drive`, and the bytes written to the EEPROM.
        self.writes = self.eeprom_writes = 0
        self._draws = _standard_normals(rng)
        self.noise_tick, self.variants = noise_tick, variants
        # Over what share of its slope the output climbs.
        self.slope_share = 1.0
        # A goal came with which the speed ramp begins anew.
        self.ramp_restarts = False
        # How long no alarm has stood.
        self.calm_s = math.inf
        # It hears nothing before this instant of the bus.
        self.deaf_until_ns = 0
        self._registered: bytes | None = None
        self._last_error = 0
        self._driven_by: tuple[int, ...] = ()
        self._drive: Drive
        self._reset()
        self.set(ax12a.ID, servo_id)

    # ------------------------------------------------------------------------------------------ registers

    def get(self, register: Register) -> int:
        """Value of a register, as a READ would report it but without noise."""
        if not register.eeprom:
            self._measure(0.0)
        return value(self.table, register)

    def set(self, register: Register, wanted: int) -> None:
        """Put a value into the table without any check or effect: the factory's or a wizard's hand."""
        self._put(register.address, wanted.to_bytes(register.size, "little"))

    def _put(self, address: int, data: bytes) -> None:
        self.table[address : address + len(data)] = data
        self.writes += 1
        self.eeprom_writes += len(data) if address < ax12a.EEPROM_END else 0

    @property
    def position_tick(self) -> float:
        """Output shaft as its potentiometer sees it, before quantisation and noise."""
        return self.shaft_rad / TICK_RAD

    @property
    def servo_id(self) -> int:
        return self.table[_ID_AT]

    @property
    def torque_enabled(self) -> bool:
        return bool(self.table[_TORQUE_ENABLE_AT])

    @property
    def baud(self) -> float:
        return 2e6 / (self.table[ax12a.BAUD.address] + 1)

    @property
    def return_delay_ns(self) -> int:
        return self.table[ax12a.RETURN_DELAY.address] * 2000

    @property
    def led(self) -> Literal["off", "on", "blinking"]:
        """The light on its case: blinking for an alarm the alarm-LED register asks for, else as its register says."""
        lingers = self.calm_s < self.variants.led_lingers_s
        if lingers or (self.alarms() | self._last_error) & value(self.table, ax12a.ALARM_LED):
            return "blinking"
        return "on" if value(self.table, ax12a.LED) else "off"

    @property
    def drive(self) -> Drive:
        """The position controller's settings now."""
        registers = DRIVING.unpack(self.table)
        if registers != self._driven_by:
            self._driven_by, self._drive = registers, drive_of(registers, self.slope_share)
        return self._drive

    def sensed_tick(self) -> int:
        """What the position sensor reads, without noise."""
        return sensed_tick(self.position_tick) if self.frozen_tick is None else self.frozen_tick

    def _measure(self, noise_tick: float) -> None:
        """Bring the measured registers up to date."""
        table, enabled = self.table, self.table[_TORQUE_ENABLE_AT] != 0
        position, speed = self.frozen_tick, 0
        if position is None:
            position = sensed_tick(self.shaft_rad / TICK_RAD + noise_tick)
            speed = round(self.velocity_rad_s / SPEED_UNIT_RAD_S)
        if not enabled and self.variants.goal_follows_when_limp:
            _GOAL.pack_into(table, _GOAL_AT, position)
        load = _signed_magnitude(round(self.output * LOAD_MAX))
        dV, degC = min(max(round(self.voltage_V * 10.0), 0), 255), min(max(round(self.temperature_degC), 0), 255)
        _MEASURED.pack_into(table, _MEASURED_AT, position, _signed_magnitude(speed), load, dV, degC)
        (goal,) = _GOAL.unpack_from(table, _GOAL_AT)
        table[_MOVING_AT] = enabled and (speed != 0 or self.reference_tick != goal)

    # --------------------------------------------------------------------------------------- instructions

    def handle(self, packet: Packet | BadChecksum) -> bytes | None:
        """React to a packet on the bus; the status packet sent back, or None for silence."""
        table, to = self.table, packet.servo_id
        servo_id, level = table[_ID_AT], table[_RETURN_LEVEL_AT]
        if to not in (servo_id, BROADCAST_ID):
            return None
        code, error, reply = -1, int(ErrorBit.CHECKSUM), b""
        if isinstance(packet, Packet):
            code = packet.code
            if code == _READ:  # most of them by far
                error, reply = self._read(packet.parameters)
            elif code in _REACTIONS:
                error = _REACTIONS[code](self, packet.parameters)
            elif self.variants.unknown_instruction_answered:
                error = int(ErrorBit.INSTRUCTION)
            else:
                return None
        elif to == BROADCAST_ID:
            return None
        error |= self.alarms()
        self._last_error = error
        if error:
            self._shut_down(error)
        pinged = code == Instruction.PING
        if to == BROADCAST_ID and not (pinged and self.variants.broadcast_ping_answered):
            return None
        if not (level == 2 or pinged or (level and code == _READ)):
            return None
        return encode_status(servo_id, error, reply)

    def _read(self, parameters: bytes) -> tuple[int, bytes]:
        """Error bits of the request, and the bytes asked for."""
        if len(parameters) != 2:
            return ErrorBit.INSTRUCTION, b""
        begin, size = parameters
        if size == 0 or begin + size > ax12a.TABLE_SIZE:
            return ErrorBit.RANGE, b""
        self._measure(self.noise_tick * (next(self._draws) if self.noise is None else self.noise))
        return 0, bytes(self.table[begin : begin + size])

    def _write(self, parameters: bytes) -> int:
        if not (error := refusal(self.table, parameters, wheel_goal=not self.variants.wheel_goal_refused)):
            self._apply(parameters[0], parameters[1:])
        return error

    def _register_write(self, parameters: bytes) -> int:
        if not (error := refusal(self.table, parameters, wheel_goal=not self.variants.wheel_goal_refused)):
            self._registered, self.table[_REGISTERED_AT] = parameters, 1
        return error

    def _action(self, _: bytes) -> int:
        if self._registered is None:
            return ErrorBit.INSTRUCTION
        parameters, self._registered, self.table[_REGISTERED_AT] = self._registered, None, 0
        return self._write(parameters)

    def _sync_write(self, parameters: bytes) -> int:
        size = parameters[1] + 1 if len(parameters) > 1 else 0
        if size < 2 or (len(parameters) - 2) % size:
            return ErrorBit.INSTRUCTION
        error, servo_id = 0, self.table[_ID_AT]
        for begin in range(2, len(parameters), size):
            if parameters[begin] == servo_id:
                error |= self._write(parameters[:1] + parameters[begin + 1 : begin + size])
        return error

    def _apply(self, address: int, data: bytes) -> None:
        names = touched(address, address + len(data))
        was_enabled = self.torque_enabled
        if not was_enabled:
            self._measure(0.0)  # a goal that followed the position is where it is now
        self._put(address, data)
        by_goal = ax12a.GOAL.name in names and self.variants.goal_write_energises
        by_speed = ax12a.MOVING_SPEED.name in names and self.variants.speed_write_energises
        if (by_goal or by_speed) and ax12a.TORQUE_ENABLE.name not in names:
            self.table[_TORQUE_ENABLE_AT] = 1
        if not self.torque_enabled:
            self.output = 0.0
            return
        if not was_enabled and value(self.table, ax12a.TORQUE_LIMIT) > 0:
            self.overloaded = False
        if not was_enabled:
            self.reference_tick = self.sensed_tick()
        self.ramp_restarts |= ax12a.GOAL.name in names and not self.variants.ramp_from_reference

    def _reset(self, _: bytes = b"") -> int:
        """Restore the factory's table."""
        self._restore(eeprom=True)
        self.reboot()
        return 0

    def reboot(self) -> None:
        """Restart the firmware: the RAM forgets, the EEPROM stays, the torque is off."""
        self._restore(eeprom=False)
        self.set(ax12a.GOAL, self.sensed_tick())
        self.set(ax12a.TORQUE_LIMIT, value(self.table, ax12a.MAX_TORQUE))
        self._registered, self._last_error = None, 0
        self.overloaded, self.output = False, 0.0

    def _restore(self, *, eeprom: bool) -> None:
        for register in ax12a.REGISTERS:
            if register.eeprom is eeprom:
                self.set(register, register.default)

    # --------------------------------------------------------------------------------------------- alarms

    def alarms(self) -> int:
        """Error bits that stand."""
        hottest_degC, lowest_dV, highest_dV = _ALARM_LIMITS.unpack_from(self.table)
        error = 0 if lowest_dV <= round(self.voltage_V * 10.0) <= highest_dV else _VOLTAGE
        if round(self.temperature_degC) > hottest_degC:
            error |= _OVERHEAT
        return error | _OVERLOAD if self.overloaded else error

    def protect(self, *, overloaded: bool = False) -> None:
        """Note an overload, and shut down if an alarm that stands is also in the shutdown register."""
        self.overloaded |= overloaded
        if error := self.alarms():
            self._shut_down(error)

    def _shut_down(self, error: int) -> None:
        if self.torque_enabled and error & value(self.table, ax12a.SHUTDOWN):
            self.set(ax12a.TORQUE_LIMIT, 0)
            self.set(ax12a.TORQUE_ENABLE, 0)
            self.output = 0.0


# What each instruction but READ does with its parameters: the error bits of the request.
_REACTIONS: dict[int, Callable[[SimulatedServo, bytes], int]] = {
    Instruction.PING: lambda _servo, _parameters: 0,
    Instruction.WRITE: SimulatedServo._write,
    Instruction.REG_WRITE: SimulatedServo._register_write,
    Instruction.ACTION: SimulatedServo._action,
    Instruction.RESET: SimulatedServo._reset,
    Instruction.SYNC_WRITE: SimulatedServo._sync_write,
}


def _signed_magnitude(value: int) -> int:
    """A speed or load as its register has it, saturating at 1023: the inverse of `ax12a.signed_magnitude`."""
    return min(-value, 1023) | 0x400 if value < 0 else min(value, 1023)


def _standard_normals(rng: np.random.Generator) -> Iterator[float]:
    """The same numbers as one draw after another; a draw by itself costs more than what it is for."""
    while True:
        yield from rng.standard_normal(DRAWS_AT_ONCE).tolist()
