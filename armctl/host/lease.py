"""Who commands the arm now: one client at a time.

A lease lasts as long as its request; while teaching or jogging, as long as that.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from armctl.errors import IllegalTransition, RequestRefused

# What has several legs, and waits before the next one if it is paused.
IN_LEGS = ("run", "play", "reach", "transfer", "program")
# What the commander itself may ask while it holds a lasting lease.
_DURING = {"teach": frozenset({"release", "torque_on", "clear", "park"}), "jogging": frozenset({"jog"})}


class Client(Protocol):
    """Whoever asks; one connection."""

    name: str
    uid: int

    def notify(self, method: str, params: dict[str, Any]) -> None:
        """Tell it something that it did not ask for."""


@dataclass(eq=False)
class Lease:
    """What one client commands now."""

    client: Client
    what: str
    # Whether that client has gone.
    lost: bool = False
    # Whether somebody asked the arm to stop meanwhile.
    stopped: bool = False
    # Whether what is to move next waits for a `resume`.
    paused: bool = False
    # How fast its legs run, of what was planned.
    rate: float = 1.0
    # Whether the arm has set off for it.
    begun: bool = False
    # What is commanded again once it ends, unless its client has gone by then.
    before: "Lease | None" = None

    def refuse_if_over(self) -> None:
        """Refuse to go on for nobody, or after a stop.

        Raises:
            RequestRefused: code LEASE_LOST or STOPPED.
        """
        when = "ended" if self.begun else "began"
        if self.lost:
            raise RequestRefused("LEASE_LOST", f"the client left before its {self.what} {when}")
        if self.stopped:
            raise RequestRefused("STOPPED", f"the {self.what} was stopped before it {when}")


class Leases:
    """The lease of the moment."""

    def __init__(self) -> None:
        self.current: Lease | None = None

    @contextmanager
    def commanding(self, client: Client, what: str) -> Iterator[Lease]:
        """Hold the lease for one request.

        Raises:
            RequestRefused: code BUSY, naming who commands.
        """
        self.refuse_if_busy(client, what)
        lease = self.current = Lease(client, what, before=(before := self.current))
        try:
            yield lease
        finally:
            if self.current is lease:
                self.current = None if before is not None and before.lost else before

    @contextmanager
    def pausing(self) -> Iterator[None]:
        """Wrap a request to pause the motion: if nothing moves just now, the next leg waits."""
        lease = self.current
        if lease is not None:
            lease.paused = lease.what in IN_LEGS
        try:
            yield
        except IllegalTransition:
            if lease is None or not lease.paused:
                raise
        else:
            if lease is not None:
                lease.paused = False

    def keep(self, client: Client, what: str) -> None:
        """From a request on, until `end`, the client commands."""
        self.current = Lease(client, what)

    def held(self) -> Iterator[Lease]:
        """The lease of the moment, then those that go on when it ends."""
        lease = self.current
        while lease is not None:
            yield lease
            lease = lease.before

    def held_by(self, client: Client) -> bool:
        return self.current is not None and self.current.client is client

    def end(self, what: str) -> None:
        """End a lasting lease, if it is that."""
        if self.current is not None and self.current.what == what:
            self.current = None

    def refuse_if_busy(self, client: Client, what: str) -> None:
        """Refuse what a client may not ask now.

        Raises:
            RequestRefused: code BUSY, somebody else commands, or this client does something else.
        """
        lease = self.current
        if lease is None or (lease.client is client and what in _DURING.get(lease.what, ())):
            return
        if what == "clear" and lease.what == "teach" and lease.client.uid == client.uid:
            return  # of a fault that has ended the teaching; it moves nothing, and whoever taught may be a closed page
        who = "this client" if lease.client is client else f"client {lease.client.name}"
        end = "end the teaching first" if lease.what == "teach" else "wait, or `armctl stop`"
        raise RequestRefused("BUSY", f"{what}: {who} commands the arm now ({lease.what}); {end}")

    def refuse_others(self, client: Client, what: str) -> None:
        """Refuse every user but the commander's own.

        Raises:
            RequestRefused: code BUSY, another user commands.
        """
        if self.current is not None and self.current.client.uid != client.uid:
            self.refuse_if_busy(client, what)

    def teaching(self, client: Client) -> None:
        """Refuse everybody but whoever teaches.

        Raises:
            IllegalTransition: this client is not teaching.
        """
        lease = self.current
        if lease is None or lease.client is not client or lease.what != "teach":
            raise IllegalTransition("this client is not teaching; teach_begin comes first")
