"""An arm set up step by step, with the person beside it: `Wizard` asks, looks at the servos, and writes the arm's file.

Rules.
1. Every step but the last finds the arm limp and leaves it limp. What moves it is the hand; only the wiggle and the
   first motion move it by themselves, small and slow, each once the person said that it may.
2. A joint turns by itself only where a hand has turned it before, and not up to its ends.
3. What a step found is on the disk when it ends. Whoever breaks off goes on there.
4. A defect is one sentence with its remedy. The person may mend it and try again; prepared answers end there.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from armctl.commissioning import eeprom
from armctl.commissioning.arm_file import drawn, renew, write
from armctl.commissioning.calibration import calibration_text, read_ticks
from armctl.commissioning.finding import YES, Opened, Person, Servo, every_servo
from armctl.commissioning.small_motions import Wall, first_motion, sense, wiggle
from armctl.commissioning.texts import refusal, said
from armctl.config import ArmConfig, Frozen, Name, parse_yaml, validate
from armctl.dynamixel import ax12a
from armctl.errors import ConfigError, RequestRefused
from armctl.files import read_text
from armctl.kinematics import robots
from armctl.trajectory.collision import link_points

STEPS = ("adapter", "servos", "joints", "directions", "rest", "zeros", "file", "motion")
# A joint that a hand leads from end to end turns by more (29 deg), and every other one by less than half as much.
LEAST_TURN_TICK = 100
# Limits end so far inside the ends that a hand has shown (2.9 deg).
MARGIN_TICK = 10
# How far outside its ends a joint may be read, by play and noise.
BEYOND_TICK = 6
BLIND = "its range goes beyond the 300 deg that its servo sees: turn the horn on the shaft, and show both ends again"


class Found(Frozen):
    """A joint's servo, and what it reads at the ends of its range; of a gripper open and closed."""

    servo: Servo
    ends_tick: tuple[float, float] = Field(strict=False)

    def wall(self, name: str) -> Wall:
        low, high = sorted(self.ends_tick)
        limits_tick = math.ceil(low) + MARGIN_TICK, int(high) - MARGIN_TICK
        return Wall(self.servo.servo_id, name, self.servo.model, limits_tick)


class Progress(Frozen):
    """What has been found of an arm."""

    # Which arm it is like, and what it is called.
    kind: str
    arm_id: Name
    servos: tuple[Servo, ...] = Field((), strict=False)
    joints: dict[str, Found] = Field(default_factory=dict)
    directions: dict[str, Literal[1, -1]] = Field(default_factory=dict)
    # What every servo of the arm reads in its rest pose, and in the pose that gives its zeros.
    rest_tick: tuple[float, ...] = Field((), strict=False)
    zero_tick: tuple[float, ...] = Field((), strict=False)


def progress_path(arm_file: Path) -> Path:
    """Where it is kept what was found of an arm whose file is not written yet."""
    return arm_file.with_suffix(".setup.json")


def progress(kind: str, arm_id: str, arm_file: Path) -> Progress:
    """What was found before of an arm that is called so, and is like that one; nothing, where nobody began.

    Raises:
        ConfigError: it cannot be read, is that of an arm of another kind, or the name is none.
    """
    path, begun = progress_path(arm_file), {"kind": kind, "arm_id": arm_id}
    told = parse_yaml(read_text(path, "progress of the set-up"), str(path)) if path.exists() else begun
    if told.get("kind") != kind:
        raise ConfigError(str(path), "kind", f"{told.get('kind')!r}, not {kind!r}", "remove the file to begin anew")
    return validate(Progress, told, str(path) if path.exists() else "armctl setup")


def known_pose(arm: ArmConfig) -> tuple[float, ...]:
    """Where the arm is held for its zeros [rad]: every joint at 0 deg, or about amid a range without 0."""
    ranges = (joint.limits_deg for joint in arm.joints)
    return tuple(0.0 if low <= 0.0 <= high else math.radians(round((low + high) / 2.0)) for low, high in ranges)


class Wizard:
    """The set-up of one arm."""

    def __init__(
        self, kind: ArmConfig, path: Path, found: Progress, opened: Opened, person: Person, period_s: float
    ) -> None:
        """
        Args:
            kind: An arm of the same shape; what differs in this one is found out.
            path: The arm's file to be.
            found: What is known already.
            period_s: Of the control step, for the first motion.
        """
        self.kind, self.path, self.found, self._period_s = kind, path, found, period_s
        self._opened, self._person = opened, person
        self._robot = robots.of(kind)
        self._grip = kind.gripper.joint if kind.gripper else ""

    def run(self) -> Iterator[dict[str, Any]]:
        """Do every step that is not done yet; of each its `name`, whether it is `ok` and a `text`, once it is over.

        Raises:
            RequestRefused: a defect that the person does not want to mend now.
            BusError: the port cannot be used.
            ConfigError: a file cannot be written.
        """
        due = [*STEPS]
        while due:
            self._keep()
            try:
                text = getattr(self, f"_{due[0]}")()
            except RequestRefused as defect:
                if not self._person.again(defect):
                    raise
                due = [*STEPS]  # what was found is kept, and what was thrown away is looked for anew
            else:
                yield {"name": due.pop(0), "ok": True, "text": text}

    # -------------------------------------------------------------------------------------------------- the servos

    def _adapter(self) -> str:
        with self._opened(()) as bus:
            return f"{bus.port.port_name} opens at {bus.port.baudrate} baud"

    def _servos(self) -> str:
        if not self.found.servos:
            self._keep(servos=every_servo(self._opened, self._person, len(self.kind.joints)))
        return f"{len(self.found.servos)} servos answer: {', '.join(str(one.servo_id) for one in self.found.servos)}"

    # -------------------------------------------------------------------------------------------------- the joints

    def _joints(self) -> str:
        for joint in self.kind.joints:
            self._show(joint.name, *(("open", "closed") if joint.name == self._grip else ("one end", "the other end")))
        return ", ".join(f"{name}: servo {one.servo.servo_id}" for name, one in self.found.joints.items())

    def _show(self, name: str, *ends: str) -> None:
        """Find out which servo turns while the hand leads a joint from end to end, and what it reads there."""
        if name in self.found.joints:
            return
        servos, readings = [Wall(one.servo_id, "some joint", "", (0, 0)) for one in self.found.servos], []
        for end in ends:
            self._person.ask(f"{name}.{end.replace(' ', '_')}", said("show", name=name, end=end))
            try:
                readings.append(self._read(servos))
            except RequestRefused as mute:
                if mute.code != "SERVO_SILENT":
                    raise
                raise refusal("UNREAD", name=name, end=end, why=str(mute).split(";")[0], blind=BLIND) from None
        ways = np.abs(np.diff(readings, axis=0)[0])
        first, *more = np.argsort(-ways).tolist()
        servo, others = self.found.servos[first], {one.servo.servo_id: key for key, one in self.found.joints.items()}
        a, b = readings[0][first], readings[1][first]
        told = {"name": name, "servo_id": servo.servo_id, "blind": BLIND}
        if ways[first] < LEAST_TURN_TICK:
            raise refusal("NOT_SHOWN little", **told)
        if more and ways[more[0]] > ways[first] / 2.0:
            raise refusal("NOT_SHOWN both", **told, other=self.found.servos[more[0]].servo_id)
        if servo.servo_id in others:
            raise refusal("NOT_SHOWN taken", **told, other=others[servo.servo_id], file=progress_path(self.path))
        if min(a, b) < 1.0 or max(a, b) > ax12a.TICK_MAX - 1.0:
            raise refusal("NOT_SHOWN blind", **told, a=a, b=b)
        self._keep(joints=self.found.joints | {name: Found(servo=servo, ends_tick=(a, b))})

    # ---------------------------------------------------------------------------------------------- the directions

    def _directions(self) -> str:
        due = [name for name in self.kind.joint_names if name not in (self._grip, *self.found.directions)]
        if due:
            middle = np.array([sum(joint.limits_rad) / 2.0 for joint in self.kind.joints])
            self._at("middle", "hold every joint about in the middle of its range", middle, 0.25)
        for name in due:
            wall = self.found.joints[name].wall(name)
            seen = sense(self._robot, middle, self.kind.joint_names.index(name))
            if self._person.ask(f"{name}.free", said("free", name=name), YES) != "yes":
                raise RequestRefused("NOT_FREE", f"{name} stays limp until it is free to turn by 9 deg both ways")
            with self._opened((wall.servo_id,)) as bus:
                wiggle(bus, wall)
            went = self._person.ask(f"{name}.went", f"did the tool {seen}, before it came back?", (*YES, "again"))
            if went == "again":
                raise RequestRefused("NOT_SEEN", f"{name}: look at the tool while it turns")
            self._keep(directions=self.found.directions | {name: 1 if went == "yes" else -1})
        return ", ".join(f"{name} {way:+d}" for name, way in self.found.directions.items())

    # ------------------------------------------------------------------------------------------------------- poses

    def _rest(self) -> str:
        pose_rad = np.array([joint.rest_rad for joint in self.kind.joints])
        self._keep(rest_tick=self.found.rest_tick or self._at("rest", said("rest"), pose_rad))
        return "read"

    def _zeros(self) -> str:
        pose_rad = known_pose(self.kind)
        named = zip(self.kind.joints, pose_rad, strict=True)
        angles = ", ".join(f"{j.name} {math.degrees(q):.0f} deg" for j, q in named if j.name != self._grip)
        self._keep(zero_tick=self.found.zero_tick or self._at("zero", said("zero", angles=angles), np.array(pose_rad)))
        return "read"

    def _at(self, key: str, text: str, pose_rad: np.ndarray, inside: float = 0.0) -> tuple[float, ...]:
        """What the servos read where a hand holds the arm.

        Args:
            inside: How much of its range every joint but the gripper has to stay away from its ends.
        """
        picture = drawn(link_points(self._robot.chain, pose_rad[: self._robot.chain.n]), self.kind.floor_m)
        self._person.ask(key, f"{picture}\n{text}")
        joints = [self.found.joints[joint.name].wall(joint.name) for joint in self.kind.joints]
        ticks = self._read(joints)
        for (servo_id, name, *_), tick in zip(joints, ticks, strict=True):
            low, high = sorted(self.found.joints[name].ends_tick)
            room = inside * (high - low) - BEYOND_TICK
            if name != self._grip and not low + room <= tick <= high - room:
                for kept in ("joints", "directions"):
                    self._keep(**{kept: {key: one for key, one in getattr(self.found, kept).items() if key != name}})
                raise refusal("NOT_THERE", servo_id=servo_id, name=name, tick=tick, low=low, high=high, blind=BLIND)
        return ticks

    def _read(self, joints: Sequence[Wall]) -> tuple[float, ...]:
        with self._opened([joint.servo_id for joint in joints]) as bus:
            return read_ticks(bus, joints, bus.port.clock)

    # -------------------------------------------------------------------------------------------------- the result

    def arm(self) -> ArmConfig:
        """The arm as it was found.

        Raises:
            ConfigError: what was found makes no arm.
        """
        told = self.kind.model_dump(mode="json", exclude_unset=True) | {"arm_id": self.found.arm_id}
        poses = zip(known_pose(self.kind), self.found.zero_tick, self.found.rest_tick, strict=True)
        for joint, item, (zero_rad, zero, rest) in zip(self.kind.joints, told["joints"], poses, strict=True):
            one, way = self.found.joints[joint.name], self.found.directions.get(joint.name, joint.direction)
            gripper = self.kind.gripper if joint.name == self._grip else None
            if gripper is not None:
                zero_rad, zero = math.radians(gripper.open_deg), one.ends_tick[0]
            zero_tick = round(zero - way * zero_rad / ax12a.TICK_RAD, 2)
            new = joint.model_copy(update={"direction": way, "zero_tick": zero_tick})
            low, high = sorted(math.degrees(new.position_rad(tick)) for tick in one.wall(joint.name).limits_tick)
            rest_deg = round(math.degrees(new.position_rad(rest)), 2)
            low, high = min(math.ceil(low * 100.0) / 100.0, rest_deg), max(math.floor(high * 100.0) / 100.0, rest_deg)
            if gripper is not None:
                told["gripper"]["closed_deg"] = closed_deg = round(math.degrees(new.position_rad(one.ends_tick[1])), 2)
                low, high = sorted((gripper.open_deg, closed_deg))
            rest_deg = min(max(rest_deg, low), high)
            item |= one.servo.model_dump() | {"direction": way, "zero_tick": zero_tick}
            item |= {"limits_deg": [low, high], "rest_deg": rest_deg}
        return validate(ArmConfig, told, "what was found")

    def _file(self) -> str:
        arm = self.arm()
        with self._opened(arm.servo_ids) as bus:
            eeprom.mend(bus, arm.joints)
        kept = renew(self.path, calibration_text(arm, [f"Set up by `armctl setup`, like {self.found.kind}."]))
        return f"{self.path} is written, and the servos have its limits" + (f"; before: {kept}" if kept else "")

    def _motion(self) -> str:
        moves = self._person.ask("motion", said("motion"), YES) == "yes"
        if moves:
            arm = self.arm()
            with self._opened(arm.servo_ids) as bus:
                first_motion(bus, arm, self._period_s)
        progress_path(self.path).unlink(missing_ok=True)
        return "every joint moved, and the arm is back at rest" if moves else "left out"

    # ----------------------------------------------------------------------------------------------------- keeping

    def _keep(self, **found: Any) -> None:
        """Note what was found, on the disk when this returns."""
        self.found = self.found.model_copy(update=found)
        write(progress_path(self.path), self.found.model_dump_json(indent=1) + "\n")
