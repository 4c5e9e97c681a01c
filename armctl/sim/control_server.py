"""A Unix stream socket that answers lines, served without ever blocking."""

import contextlib
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

from armctl.errors import ConfigError, PortBusy

MAX_LINE_BYTES = 65536
MAX_PATH_BYTES = 107


@dataclass
class _Connection:
    # The begin of a line.
    incoming: bytes = b""
    # What is being sent; empty: no answer is under way.
    outgoing: bytes = b""
    # What is to be sent after that; set together with it.
    pieces: Iterator[str] = field(init=False)


class ControlServer:
    """The listening socket and its clients, served without ever blocking."""

    def __init__(self, path: Path, answer: Callable[[bytes], Iterator[str]]) -> None:
        """Listen on `path`; a dead simulator's socket there is replaced.

        Args:
            answer: Gives the pieces, none of them empty, of the line that answers a line.
        Raises:
            ConfigError: the path is too long or cannot be created.
            PortBusy: another simulator listens there.
        """
        if len(str(path).encode()) > MAX_PATH_BYTES:
            too_long = f"longer than the {MAX_PATH_BYTES} bytes of a socket's name"
            raise ConfigError(str(path), "", too_long, "shorten --link")
        self._path, self._answer = path, answer
        self._connections: dict[socket.socket, _Connection] = {}
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_socket():
                with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
                    if probe.connect_ex(str(path)) == 0:
                        raise PortBusy(f"{path}: another simulator runs here; stop it or choose another --link")
                path.unlink()
            self._listener.bind(str(path))
        except (OSError, PortBusy) as error:
            self._listener.close()
            if isinstance(error, PortBusy):
                raise
            raise ConfigError(str(path), "", f"cannot listen: {error.strerror}") from None
        self._listener.listen()
        self._listener.setblocking(False)

    def readers(self) -> list[socket.socket]:
        """Sockets to wait on for reading; a client with an answer under way is not heard."""
        return [self._listener, *(s for s, connection in self._connections.items() if not connection.outgoing)]

    def writers(self) -> list[socket.socket]:
        """Sockets to wait on for writing."""
        return [s for s, connection in self._connections.items() if connection.outgoing]

    def serve(self, ready: Sequence[socket.socket]) -> None:
        """Read from and write to the sockets that are ready, a little of each."""
        for sock in ready:
            if sock is self._listener:
                with contextlib.suppress(BlockingIOError):
                    accepted, _ = self._listener.accept()
                    accepted.setblocking(False)
                    self._connections[accepted] = _Connection()
                continue
            connection = self._connections[sock]
            try:
                if connection.outgoing:
                    self._send(sock, connection)
                else:
                    self._receive(sock, connection)
            except BlockingIOError:
                pass
            except OSError:
                self._drop(sock)

    def close(self) -> None:
        """Drop every client and remove the socket."""
        for sock in list(self._connections):
            self._drop(sock)
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _drop(self, sock: socket.socket) -> None:
        del self._connections[sock]
        sock.close()

    def _receive(self, sock: socket.socket, connection: _Connection) -> None:
        data = sock.recv(MAX_LINE_BYTES)
        *lines, connection.incoming = (connection.incoming + data).split(b"\n")
        if not data or len(connection.incoming) > MAX_LINE_BYTES:
            self._drop(sock)
            return
        connection.pieces = chain.from_iterable([chain(self._answer(line), "\n") for line in lines])
        connection.outgoing = next(connection.pieces, "").encode()

    def _send(self, sock: socket.socket, connection: _Connection) -> None:
        left = connection.outgoing[sock.send(connection.outgoing) :]
        connection.outgoing = left or next(connection.pieces, "").encode()
