"""Teaching: a hand guides the limp arm through takes.

The teaching client holds the lease from `begin` to `end`; however it goes, it leaves a limp arm.
"""

from typing import Any

from armctl.errors import IllegalTransition
from armctl.host.host import Host
from armctl.host.lease import Client
from armctl.messages import Teach, TeachEnd

_NO_TAKE = "no take is being recorded; take_begin comes first"


async def begin(host: Host, client: Client) -> dict[str, Any]:
    """Make the arm limp, verified so by the servos; the client keeps the lease until `end`.

    Raises:
        LogError: no take could be recorded; the arm stays as it is.
    """
    host.takes.check()
    with host.leases.commanding(client, "teach_begin") as lease:
        await host.exchange.request(Teach)
        if lease.lost:
            await host.exchange.request(TeachEnd)
    if not lease.lost:
        host.leases.keep(client, "teach")
    return host.state()


async def take_begin(host: Host, client: Client, name: str) -> dict[str, Any]:
    """Start recording a take.

    Raises:
        LogError: the name is taken, or the file cannot be written.
    """
    host.leases.teaching(client)
    if host.takes.name is not None:
        raise IllegalTransition(f"take {host.takes.name} is being recorded; take_end comes first")
    return {"recording": name, "path": str(await host.takes.begin(name))}


async def take_mark(host: Host, client: Client) -> dict[str, Any]:
    """Mark where the tool is now as a via point, in the take."""
    _taking(host, client)
    latest = host.latest
    if latest is None or latest.outputs.tool is None:
        raise IllegalTransition(_NO_TAKE)
    marked = {
        "tick": latest.inputs.tick,
        "position_m": list(latest.outputs.tool.position_m),
        "joints_rad": [joint.position_rad for joint in latest.outputs.joints],
    }
    host.note({"event": "VIA_MARK", **marked})
    return marked


async def take_end(host: Host, client: Client) -> dict[str, Any]:
    """Finish the take."""
    return {"recording": _taking(host, client), "path": str(await host.takes.end())}


async def end(host: Host, client: Client) -> dict[str, Any]:
    """Leave teach mode, keeping a take that is still open; the arm stays limp."""
    host.leases.teaching(client)
    lease = host.leases.current
    try:
        await host.end_teaching()
    finally:
        if host.leases.current is lease:
            host.leases.current = None
    return host.state()


def _taking(host: Host, client: Client) -> str:
    """The name of the take that this teaching client records."""
    host.leases.teaching(client)
    if host.takes.name is None:
        raise IllegalTransition(_NO_TAKE)
    return host.takes.name
