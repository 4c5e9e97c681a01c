"""Clients of the daemon's socket: one waits for each answer, `asynchronous` lets calls overlap."""

from armctl.client.blocking import Client

__all__ = ["Client"]
