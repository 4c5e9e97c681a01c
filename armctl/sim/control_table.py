"""The rules of writing to a servo's control table; a write counts as a whole or not at all."""

from functools import cache

from armctl.dynamixel import ax12a

# Addresses that stay writable after LOCK.
LOCKED_WRITABLE = range(24, 36)


def value(table: bytes | bytearray, register: ax12a.Register) -> int:
    """Value of a register in a whole table."""
    at = register.address
    return table[at] | table[at + 1] << 8 if register.size == 2 else table[at]


@cache
def touched(begin: int, end: int) -> dict[str, ax12a.Register]:
    """Registers that overlap the addresses begin..end-1, by name."""
    return {r.name: r for r in ax12a.REGISTERS if r.address < end and r.address + r.size > begin}


def refusal(table: bytearray, parameters: bytes, *, wheel_goal: bool) -> int:
    """Error bits of a write that must not happen; 0: it may.

    Args:
        parameters: The first address, and the bytes from there on.
        wheel_goal: Whether a goal may be written in wheel mode, where it means nothing.
    """
    if len(parameters) < 2:
        return ax12a.ErrorBit.INSTRUCTION
    begin, data = parameters[0], parameters[1:]
    end = begin + len(data)
    if end > ax12a.TABLE_SIZE:
        return ax12a.ErrorBit.RANGE
    if table[ax12a.LOCK.address] and not (begin in LOCKED_WRITABLE and end - 1 in LOCKED_WRITABLE):
        return ax12a.ErrorBit.RANGE
    after = bytearray(table)
    after[begin:end] = data
    low, high = value(table, ax12a.CW_LIMIT), value(table, ax12a.CCW_LIMIT)
    error, wheel, torque = 0, low == high == 0, table[ax12a.TORQUE_ENABLE.address]
    for register in touched(begin, end).values():
        wanted = value(after, register)
        highest = ax12a.TICK_MAX if register is ax12a.MOVING_SPEED and not wheel else register.maximum
        if not (register.writable and (register.minimum <= wanted <= highest)) or (register.eeprom and torque):
            error |= int(ax12a.ErrorBit.RANGE)
        elif register is ax12a.GOAL and not (wheel_goal if wheel else low <= wanted <= high):
            error |= int(ax12a.ErrorBit.ANGLE_LIMIT)
    return error
