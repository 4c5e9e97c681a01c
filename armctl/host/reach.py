"""Reaching for a point, and gripping what is there: several short motions, one recording."""

from collections.abc import Sequence
from typing import Any

from armctl.clock import NS_PER_S
from armctl.host.host import Host
from armctl.host.lease import Client
from armctl.host.motions import move_result
from armctl.host.watch import Done, Leg
from armctl.kinematics.transform import FloatArray
from armctl.messages import JointTrajectory
from armctl.trajectory import grasp
from armctl.trajectory.grasp import GripRequest, ReachRequest

# The leg after which the tool is at the point.
_THERE = 1


async def reach(host: Host, client: Client, request: ReachRequest) -> dict[str, Any]:
    """Approach, straight to the point, and there stay, or grip or let go and back off; recorded and measured.

    Raises:
        RequestRefused: UNREACHABLE with the nearest distance, NO_GRIPPER, pre-flight (every reason), POSTURE (those
            there are), BUSY, stopped or failed on the way.
        LogError: the recording cannot be made.
    """
    note = {"event": "REACH", **request.model_dump(exclude_none=True)}
    name, done = await host.execute(client, "reach", _legs(host, request), note)
    result: dict[str, Any] = {
        "recording": name,
        **move_result(done[_THERE], host.robot),
        "method": request.ik,
        "duration_s": (done[-1].watch.time_ns[-1] - done[0].watch.time_ns[0]) / NS_PER_S,
        "gripped": None,
    }
    if request.gripper == "stay":
        return result
    index, gripper = grasp.gripper_of(host)
    now = host.status()["joints"][index]
    return {
        **result,
        "gripped": gripped(host, done) if request.gripper == "grip" else False,
        "gripper": {
            "joint": gripper.joint,
            "position_rad": now["position_rad"],
            "load_ratio": now["load_ratio"],
            **({} if gripper.open_mm is None else {"opening_mm": gripper.opening_mm(now["position_rad"])}),
        },
        "lifted_m": move_result(done[-1], host.robot)["position_m"],
    }


async def grip(host: Host, client: Client, request: GripRequest) -> dict[str, Any]:
    """Close the gripper until its load says that it holds something, or open it; recorded and measured.

    Raises:
        RequestRefused: NO_GRIPPER, pre-flight (every reason), BUSY, stopped or failed on the way.
        LogError: the recording cannot be made.
    """
    closing = request.grip == "close"
    name, done = await host.execute(client, "grip", [lambda q_now: grasp.gripping(q_now, host, closing=closing)])
    return {"recording": name, **move_result(done[0], host.robot), "gripped": closing and gripped(host, done)}


def gripped(host: Host, done: Sequence[Done]) -> bool:
    """Whether the gripper met something when it closed, and holds it."""
    return any(leg.reply.code == "GRIPPED" for leg in done) and host.holds()


def _legs(host: Host, request: ReachRequest) -> list[Leg]:
    """The legs of one reach; the first plans the way, before anything moves."""
    planned: list[FloatArray] = []

    def approach(q_now: Sequence[float]) -> JointTrajectory:
        if request.gripper != "stay":
            grasp.gripper_of(host)
        planned.append(grasp.plan_grasp(request, q_now, host))
        return grasp.approach(planned[0], q_now, host, opening=request.gripper == "grip")

    def straight(step: int) -> Leg:
        return lambda q_now: grasp.straight(planned[0][::step], q_now, host)

    def act(q_now: Sequence[float]) -> JointTrajectory:
        return grasp.gripping(q_now, host, closing=request.gripper == "grip")

    there = [approach, straight(1)]
    return there if request.gripper == "stay" else [*there, act, straight(-1)]
