"""The SDK's packet handler, with a short cut for the reply that comes nearly always: whole, and with a good checksum.

The SDK looks for the header and sums up the bytes one by one, in Python: half of the processor time of a reading.
"""

from __future__ import annotations

from collections.abc import Sequence

from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, Protocol1PacketHandler

from armctl.dynamixel.packet import OVERHEAD_BYTES
from armctl.dynamixel.port import HEARD_MAX, ServoPort

ID_MAX, LENGTH_MAX, ERROR_MAX = 0xFD, 250, 0x7F
"""What the SDK takes for the begin of a status packet."""


class PacketHandler(Protocol1PacketHandler):  # type: ignore[misc]  # the SDK has no types
    """Does what its base does, in less time."""

    def rxPacket(self, port: ServoPort) -> tuple[Sequence[int], int]:
        """The next status packet and how receiving it went; waits as long as the SDK would."""
        head = port.peek(OVERHEAD_BYTES)
        if not head:
            port.is_using = False
            return (), COMM_RX_TIMEOUT
        # A line that has babbled is heard no further than the SDK would hear it.
        if len(head) == OVERHEAD_BYTES and head[0] == head[1] == 0xFF and port.heard + OVERHEAD_BYTES < HEARD_MAX:
            servo_id, length, error = head[2], head[3], head[4]
            if servo_id <= ID_MAX and 2 <= length <= LENGTH_MAX and error <= ERROR_MAX:
                packet = port.peek(length + 4)
                if len(packet) == length + 4 and sum(packet) & 0xFF == 0xFD:  # 2 * 0xFF of the header, 0xFF of the rest
                    port.is_using = False
                    return port.readPort(length + 4), COMM_SUCCESS
        found: tuple[Sequence[int], int] = super().rxPacket(port)  # it reads again what was only looked at
        return found
