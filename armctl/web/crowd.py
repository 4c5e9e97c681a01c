"""HTTP connections that keep the server waiting, and how many there may be.

Rules.
1. A client owes the rest of a request it has begun (a connection begins one), or to take the answer to it. What it owes
   has to come within `DUE_S` in all, however many bytes come meanwhile.
2. There are `PLACES` connections. One more takes the place of the one that owes something longest, else of the one that
   has nothing to ask longest: half-sent requests never keep out a whole one, such as STOP.
3. Live views have places of their own, `VIEWS`.
4. A client that is sent away is told why (408 or 503), where it has not begun to receive an answer.
"""

import asyncio
import json
from http import HTTPStatus
from typing import Any, Literal

from uvicorn.protocols.http.h11_impl import H11Protocol

PLACES = 64
VIEWS = 64

Owes = Literal["request", "answer", "nothing", "served"]
# Within how long it has to come, and what is said where it does not.
DUE_S: dict[Owes, float] = {"request": 5.0, "answer": 30.0}
MISSED: dict[Owes, str] = {"request": "the request is not whole", "answer": "the answer is not taken"}


class Connection(H11Protocol):
    """One HTTP connection that keeps these rules; the rest is uvicorn's."""

    _owes: Owes = "request"
    _since_s = 0.0
    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._owe("request")
        others = [one for one in self.connections if isinstance(one, Connection) and one is not self]
        if len(others) >= PLACES:
            waiting = [one for one in others if one._owes != "served"]
            crowd = f"{PLACES} connections are open"
            if waiting:
                victim = min(waiting, key=lambda one: (one._owes == "nothing", one._since_s))
                victim._send_away(503, "BUSY", f"{crowd}, and this one kept the server waiting longest; ask again")
            else:
                self._send_away(503, "BUSY", f"{crowd}, all with a request under way; close a page or wait")

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_timer()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._look()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._look()

    def resume_writing(self) -> None:
        super().resume_writing()
        self._look()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._look()

    def handle_websocket_upgrade(self, event: Any) -> None:
        if sum(not isinstance(one, Connection) for one in self.connections) >= VIEWS:
            self._send_away(503, "BUSY", f"{VIEWS} live views are open; close a page")
            return
        self._stop_timer()
        super().handle_websocket_upgrade(event)

    def _look(self) -> None:
        """See what the client owes now."""
        # Otherwise it is a WebSocket's by now, or gone.
        if self in self.connections and (owes := self._debt()) != self._owes:
            self._owe(owes)

    def _owe(self, owes: Owes) -> None:
        """The clock of a new debt begins."""
        self._stop_timer()
        self._owes, self._since_s = owes, self.loop.time()
        if owes in DUE_S:
            reason = f"{MISSED[owes]} after {DUE_S[owes]:g} s; ask again, all at once"
            self._timer = self.loop.call_later(DUE_S[owes], self._send_away, 408, "TOO_SLOW", reason)

    def _debt(self) -> Owes:
        if self.flow.write_paused:
            return "answer"
        if self.cycle is None or self.cycle.response_complete:
            return "request" if self.cycle is None or bool(self.conn.trailing_data[0]) else "nothing"
        return "request" if self.cycle.more_body else "served"

    def _send_away(self, status: int, code: str, reason: str) -> None:
        """Close at once, with a reason where no answer has begun."""
        self._stop_timer()
        self.connections.discard(self)
        if self.cycle is None or self.cycle.response_complete or not self.cycle.response_started:
            body = json.dumps({"error": {"code": code, "message": reason, "reasons": [reason]}}).encode()
            head = f"HTTP/1.1 {status} {HTTPStatus(status).phrase}\r\ncontent-type: application/json\r\n"
            self.transport.write(f"{head}content-length: {len(body)}\r\nconnection: close\r\n\r\n".encode() + body)
        self.transport.abort()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
