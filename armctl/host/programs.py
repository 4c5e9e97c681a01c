"""Programs that the daemon runs: checked as a whole, done step by step, resumed where they stand.

Rules.
1. A program is one request, one lease and one recording, whose notes name every step and turn as it begins and ends.
   Anybody may stop or pause it, in a step or between two.
2. Before anything moves, every motion is made from where the steps before it end, of both branches of an `if_gripped`.
   Each is made and checked again when it is due, from where the arm then is.
3. Where a program stands is on the disk before a step begins and once it has ended. So whatever ends it, no step is
   left out; the one that was under way is done again, from its begin.
4. It goes on there unless that is no longer what was begun: another program, another arm, or what was gripped is lost.
5. A `move` leaves the gripper as it is; `grip` moves it, and `play` where it was taught.
"""

import asyncio
import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armctl.config import Frozen, parse_yaml, validate
from armctl.errors import ArmctlError, ConfigError, RequestRefused
from armctl.files import read_text
from armctl.host.host import Host
from armctl.host.jsonrpc import error_data
from armctl.host.lease import Client, Lease
from armctl.host.motions import move_trajectory
from armctl.host.reach import gripped
from armctl.host.watch import Leg, run_name
from armctl.recording import recordings
from armctl.recording.disk import put
from armctl.trajectory import grasp
from armctl.trajectory.path_motion import path_motion
from armctl.trajectory.playback import playback
from armctl.trajectory.preflight import DrivenArm
from armctl.trajectory.program import Instruction, Program, ProgramRequest, Step, place_of, written_out
from armctl.trajectory.target import MoveRequest

# From so many different poses at most may a step begin, by the branches before it.
MOST_POSES = 8
ANEW = "`--from 1` begins anew"
UNCHECKED = "not checked, because a step before it cannot be done"

Joints = tuple[float, ...]


class Standing(Frozen):
    """Where a program stands that has not ended."""

    # Of the program and the arm it was begun with.
    digest: str
    # Of its instructions, the one that is due, and its name.
    index: int
    at: str
    gripped: bool


@dataclass
class Site(DrivenArm):
    """The arm that programs are for, and the folder of its recordings, beside which it is kept where programs stand."""

    recordings_dir: Path

    def legs(self, step: Step) -> list[Leg]:
        """The motions of a step.

        Raises:
            ArmctlError: there is no such recording, it cannot be played, or the arm has no gripper.
        """
        if (move := step.move) is not None:
            return [lambda q_now: move_trajectory(self._gripper_stays(move, q_now), q_now, self)]
        if (path := step.path) is not None:
            return [lambda q_now: path_motion(path, q_now, self).trajectory]
        if (play := step.play) is not None:
            if (motion := play.motion) is None:
                motion = recordings.taught(recordings.load(recordings.find(self.recordings_dir, play.name or "")))
            return [playback(motion, play.rate, self).trajectory] * play.repeat
        if step.grip or step.if_gripped:
            grasp.gripper_of(self)
        return [lambda q_now: grasp.gripping(q_now, self, closing=step.grip == "close")] if step.grip else []

    def _gripper_stays(self, move: MoveRequest, q_now: Sequence[float]) -> MoveRequest:
        if move.joints_rad is None or self.arm.gripper is None or len(move.joints_rad) != len(q_now):
            return move
        index, _ = grasp.gripper_of(self)
        joints_rad = (*move.joints_rad[:index], q_now[index], *move.joints_rad[index + 1 :])
        return move.model_copy(update={"joints_rad": joints_rad})

    def check(self, program: Program, q_now: Joints, begin: int = 0) -> Iterator[dict[str, Any]]:
        """Every step that can be reached, as `name`, `ok` and `text`; a turn has a row of its own where it differs.

        Args:
            q_now: Where the joints are before it [rad], shape (joints,).
            begin: Which instruction comes first.
        """
        instructions = written_out(program)
        poses: list[dict[Joints, Joints]] = [{} for _ in range(len(instructions) + 1)]
        found: dict[tuple[int, Joints], tuple[Joints, float]] = {}
        told: set[tuple[str, bool]] = set()

        def lead(index: int, q: Joints) -> None:
            poses[index][tuple(round(angle, 6) for angle in q)] = q

        lead(begin, q_now)
        for index, one in enumerate(instructions[begin:], begin):
            here, wrong, took_s = poses[index], [] if poses[index] else [UNCHECKED], 0.0
            if one.step is None:
                for q in here.values():
                    lead(one.other, q)
                continue
            if len(here) > MOST_POSES:
                here, wrong = {}, [f"more than {MOST_POSES} poses lead here; let a move to joint positions come before"]
            for key, q in here.items():
                try:
                    end = found.get((id(one.step), key)) or self._end(one.step, q)
                except ArmctlError as error:
                    wrong += [reason for reason in error_data(error)["reasons"] if reason not in wrong]
                    continue
                found[id(one.step), key] = end
                took_s = max(took_s, end[1])
                for following in {index + 1, one.other if one.step.if_gripped else index + 1}:
                    lead(following, end[0])
            if (one.name, not wrong) not in told:
                told.add((one.name, not wrong))
                text = "; ".join(wrong) or one.step.words + (f", {took_s:.1f} s" if took_s else "")
                yield {"name": one.at if wrong else one.name, "ok": not wrong, "text": text}

    def _end(self, step: Step, q: Joints) -> tuple[Joints, float]:
        """Where a step ends that begins there, and how long it takes [s]; raises why it cannot."""
        took_s = 0.0
        for leg in self.legs(step)[:2]:  # what is repeated begins where it ended before
            trajectory = leg(q)
            q, took_s = trajectory.positions_rad[-1], took_s + trajectory.duration_s
        return q, took_s

    # ------------------------------------------------------------------------------------ where it stands

    def file(self, program: Program) -> Path:
        """Where it is kept how far a program has come that has not ended."""
        return self.recordings_dir.parent / "programs" / f"{program.name}.json"

    def _digest(self, program: Program) -> str:
        what = program.model_dump_json(include={"steps"}) + self.arm.arm_id + self.arm.calibration_hash
        return hashlib.sha256(what.encode()).hexdigest()

    def keep(self, program: Program, index: int, *, gripped: bool) -> None:
        """Keep which instruction is due, on the disk when this returns: the first again, once all are done.

        Raises:
            LogError: it cannot be written.
        """
        index %= len(instructions := written_out(program))
        standing = Standing(digest=self._digest(program), index=index, at=instructions[index].at, gripped=gripped)
        put(self.file(program), standing.model_dump_json())

    def begin(self, program: Program, from_step: str | None, *, holding: bool) -> tuple[int, bool]:
        """Which instruction comes first, and whether something is gripped by then.

        Args:
            holding: Whether the gripper holds something now.
        Raises:
            RequestRefused: code NO_STEP; or NOT_RESUMED, why it cannot go on where it stands.
        """
        instructions, path = written_out(program), self.file(program)
        if from_step is not None:
            return place_of(instructions, from_step), holding
        if not path.exists():
            return 0, holding
        try:
            standing = validate(Standing, parse_yaml(read_text(path, "standing"), str(path)), str(path))
        except ConfigError as error:
            raise RequestRefused("NOT_RESUMED", f"where it stands cannot be read: {error}; {ANEW}") from None
        if standing.index == 0:
            return 0, holding
        stands = f"program {program.name} stands at step {standing.at}"
        if standing.digest != self._digest(program) or not 0 < standing.index < len(instructions):
            raise RequestRefused("NOT_RESUMED", f"{stands}, and it or the arm's file has changed since; {ANEW}")
        due = instructions[standing.index].step
        if standing.gripped and not holding and due is not None and due.grip is None:
            why = f"{stands} with something gripped, and the gripper does not hold it any more"
            raise RequestRefused("NOT_RESUMED", f"{why}; `--from {standing.at}` goes on all the same, {ANEW}")
        return standing.index, standing.gripped and holding


def pose_now(host: Host) -> Joints:
    """Where a program that is only checked would begin [rad]: where the arm is; its rest pose, if that is not known."""
    outputs = host.latest.outputs if host.latest is not None else None
    if outputs is None or not all(joint.known for joint in outputs.joints):
        return tuple(joint.rest_rad for joint in host.arm.joints)
    return outputs.wanted_rad or tuple(joint.position_rad for joint in outputs.joints)


def checked(site: Site, program: Program, q_now: Joints) -> dict[str, Any]:
    """Every step of a program from a pose [rad] as `name`, `ok` and `text`, and the step where a run would go on."""
    return {"steps": list(site.check(program, q_now)), "resumed_at": stands_at(site, program)}


def stands_at(site: Site, program: Program) -> str | None:
    """Name of the step at which a run would go on; None: it would begin anew, or not at all."""
    try:
        index, _ = site.begin(program, None, holding=True)
    except RequestRefused:
        return None
    return written_out(program)[index].at if index else None


async def run(host: Host, client: Client, site: Site, request: ProgramRequest) -> dict[str, Any]:
    """Run a program from where it stands, or from the step that is named, to its end.

    Returns:
        The steps that were done as `name`, `ok` and `text`; `resumed_at`, the step it began with if that was not the
        first; `ended`, what ended it before its time, or None, and `stands_at`, the step at which it then stands.
    Raises:
        RequestRefused: NO_STEP, NOT_RESUMED, PREFLIGHT (every step that cannot be done), BUSY, the arm does not hold.
        LogError: the recording cannot be made.
    """
    with host.leases.commanding(client, "program") as lease:
        return await _Job(host, lease, site, request).done()


class _Job:
    def __init__(self, host: Host, lease: Lease, site: Site, request: ProgramRequest) -> None:
        self.host, self.lease, self.site, self.request = host, lease, site, request
        self.instructions = written_out(request)
        self.rows, self.gripped = list[dict[str, Any]](), False

    async def done(self) -> dict[str, Any]:
        """Everything; the answer."""
        host, program = self.host, self.request
        index, self.gripped = self.site.begin(program, program.from_step, holding=host.holds())
        rows = await asyncio.to_thread(list, self.site.check(program, host.commanded_joints("program"), index))
        wrong = [f"step {row['name']}: {row['text']}" for row in rows if not row["ok"] and row["text"] != UNCHECKED]
        if wrong:
            raise RequestRefused("PREFLIGHT", wrong)
        ended, resumed_at = None, self.instructions[index].at if index else None
        if index:
            self.lease.client.notify("progress", {"step": resumed_at, "text": f"the program begins here; {ANEW}"})
        async with host.takes.around(run_name(f"program-{program.name}")) as recording:
            host.note({"event": "PROGRAM", **program.model_dump(mode="json", exclude_none=True)})
            try:
                await asyncio.to_thread(self.site.keep, program, index, gripped=self.gripped)
                while index < len(self.instructions):
                    index = await self._step(index, self.instructions[index])
            except ArmctlError as error:
                ended = {"code": error_data(error)["code"], "text": str(error)}
            result = {"resumed_at": resumed_at, "ended": ended, "stands_at": ended and self.instructions[index].at}
            host.note({"event": "PROGRAM_END", "name": program.name, **result})
        return {"recording": recording, "steps": self.rows, **result}

    async def _step(self, index: int, one: Instruction) -> int:
        """Do what is due; the index of what is due then, which is kept."""
        assert one.step is not None  # what only leads on is never due
        row = {"name": one.at, "ok": True, "text": one.step.words}
        told = {"step": one.at, "number": index + 1, "of": len(self.instructions), "text": one.step.words}
        self.host.note({"event": "PROGRAM_STEP", "program": self.request.name, **told})
        self.lease.client.notify("progress", told)
        self.rows.append(row)
        try:
            row["text"] = await self._do(one.step)
            index = one.other if one.step.if_gripped and not self.gripped else index + 1
            while index < len(self.instructions) and self.instructions[index].step is None:
                index = self.instructions[index].other
            await asyncio.to_thread(self.site.keep, self.request, index, gripped=self.gripped)
        except ArmctlError as error:
            row |= {"ok": False, "text": str(error)}
            raise
        finally:
            self.host.note({"event": "PROGRAM_STEP_END", "program": self.request.name, **row})
        self.lease.client.notify("progress", {"step": one.at, "text": row["text"], "done": True})
        return index

    async def _do(self, step: Step) -> str:
        """What became of a step, for people."""
        left = math.ceil((step.wait_s or 0.0) / self.site.period_s)
        while left > 0:
            self.lease.refuse_if_over()
            self.host.commanded_joints("program")
            await self.host.tick()
            left -= not self.lease.paused  # while it is paused no time passes
        if step.if_gripped:
            self.gripped = self.gripped and self.host.holds()
            return f"gripped: {'yes' if self.gripped else 'nothing'}"
        if not (legs := await asyncio.to_thread(self.site.legs, step)):
            return step.words
        _, done = await self.host.carry_out(self.lease, legs)
        if step.grip or step.play:  # what is played moves the gripper, too
            self.gripped = gripped(self.host, done) if step.grip else self.gripped and self.host.holds()
        found = f", gripped: {'yes' if self.gripped else 'nothing'}" if step.grip == "close" else ""
        return f"{step.words}, {sum(leg.trajectory.duration_s for leg in done):.1f} s{found}"
