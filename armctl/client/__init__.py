"""Clients of the daemon's socket: one waits for each answer, `asynchronous` lets calls overlap, `stop` only stops."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from armctl.client.blocking import Client

__all__ = ["Client"]


def __getattr__(name: str) -> Any:
    # Not before it is used: `armctl stop` does without.
    if name == "Client":
        from armctl.client.blocking import Client

        return Client
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
