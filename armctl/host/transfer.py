"""A pick-and-transfer cycle: one motion, one recording, which says itself what the cycle was."""

from collections.abc import Sequence
from typing import Any

from armctl.host.host import Host
from armctl.host.lease import Client
from armctl.host.motions import move_result
from armctl.messages import JointTrajectory
from armctl.trajectory.transfer import NOTED, TransferRequest, transfer_trajectory


async def transfer(host: Host, client: Client, request: TransferRequest) -> dict[str, Any]:
    """Approach slowly, run the cycle, record it.

    Raises:
        RequestRefused: UNREACHABLE, pre-flight (every reason), BUSY, stopped or failed on the way.
        LogError: the recording cannot be made.
    """

    def make(q_now: Sequence[float], _: Sequence[float]) -> JointTrajectory:
        return transfer_trajectory(request, q_now, host.arm, host.robot, host.period_s)

    name, [done] = await host.execute(client, "transfer", [make], {"event": NOTED, "cycle": request.model_dump()})
    return {
        "recording": name,
        **move_result(done.watch, done.trajectory, host.robot),
        "cycle_s": done.trajectory.end_s - done.trajectory.begin_s,
    }
