"""What comes back to a request, or why nothing good did."""

from typing import NamedTuple

NO_REPLY = "NO_REPLY"
BUS_NOISE = "BUS_NOISE"
PORT_GONE = "PORT_GONE"


class Reply(NamedTuple):
    """What came back to one request; `problem` is empty when it is good."""

    data: bytes = b""
    error: int = 0
    problem: str = ""
    elapsed_ns: int = 0
