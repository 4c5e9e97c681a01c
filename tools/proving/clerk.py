"""The user of an episode: wants runs, parks and teaches, follows every fault's card, and says wrong things at times.

The clerk knows what `armctl status` shows, and what a person at the arm sees: where it is, whether it is limp, which
fault still strikes. Each of his doings is a generator of one tick's commands; what he asks for `requests.py` draws.
"""

from __future__ import annotations

import math

import numpy as np

from armctl.dynamixel import ax12a
from armctl.messages import (
    Clear,
    Command,
    Hold,
    Jog,
    Mode,
    Park,
    Pause,
    Release,
    Resume,
    Run,
    SetRate,
    Teach,
    TeachEnd,
    TickRecord,
)
from armctl.sim.faults import Fault
from armctl.trajectory.preflight import DrivenArm, preflight_motion
from proving.person import Doing, Person
from proving.reading import RESTING
from proving.story import Wish

# When faults end, the arm is ready (latched) within this time.
READY_S = 3.0
# From a `clear` to a moving arm.
MOVE_S = 1.0
# A card that does not lead out of a fault in so long does not tell the truth.
PATIENCE_S = 60.0
# How often a run is asked for first that must be refused.
WRONG_SHARE = 0.2
LEAN_S = 4.0
# At the default compliance 27 are 82 % of a servo's output, and 7.9 deg: not far enough to count as blocked, too hard
# to go on. Less is nothing but a push, more is blocked. And how long the joint is held.
LEANS = {
    "lean": (27, 28, LEAN_S), "strain": (27, 28, 8.0), "press": (18, 24, 8.0), "ram": (40, 80, 8.0),
    "aside": (18, 24, 0.1),
}  # fmt: skip
# What alone speaks against a motion.
AGAINST = {"fold": "into each other", "sink": "below the floor", "sweep": "its tool reaches"}


class Clerk(Person):
    """One user; `commands` is asked before each tick, `see` told after it."""

    # ------------------------------------------------------------------------------------ the loop's side

    def commands(self, now_s: float) -> tuple[Command, ...]:
        """What the user says now."""
        self._now_s = now_s
        said: tuple[Command, ...] = ()
        if self._record is not None:
            if self._doing is None:
                self._doing = self._next()
            if self._doing is not None:
                try:
                    said = next(self._doing)
                except StopIteration:
                    self._doing = None
        while self._words and self._words[0].at_s <= now_s:
            word = self._words.pop(0)
            said += self._requests.blurt(word, self._id(), None if self._record is None else self._commanded())
        return said

    def see(self, now_s: float, record: TickRecord) -> None:
        """What came of the tick."""
        self._now_s, self._record = now_s, record
        for reply in record.outputs.replies:
            self._replies[reply.request_id] = reply

    def lost(self) -> None:
        """The program in charge is gone: whatever was asked for is void."""
        self._record, self._doing = None, None

    # ------------------------------------------------------------------------------------------- doings

    def _next(self) -> Doing | None:
        if self._code:
            return self._recover()
        if self._episode.body.hand.holding:
            return self._let_go()
        if self._wishes and self._wishes[0].at_s <= self._now_s:
            wish = self._wishes.pop(0)
            while self._wishes and self._wishes[0].at_s <= self._now_s:
                wish = self._wishes.pop(0)
            return self._grant(wish)
        return None

    def _grant(self, wish: Wish) -> Doing:
        rng = np.random.default_rng(wish.number)
        match wish.what:
            case "run" | "mixed":
                yield from self._run(rng, wish.what == "mixed")
            case "plan":
                yield from self._run(rng, mixed=False, planned=True)
            case "park":
                yield from self._power_up(rng)
                yield from self._ask(Park(self._id()), 30.0)
            case "halt":
                yield from self._halt(rng)
            case "jog":
                yield from self._jog(rng)
            case "stand":
                yield from self._power_up(rng)
            case "lift":
                yield from self._power_up(rng, lifted=True)
            case "lean" | "strain" | "press" | "ram" | "aside":
                yield from self._lean(rng, wish.what)
            case "fold" | "sink" | "sweep" | "dash":
                yield from self._power_up(rng)
                yield from self._plan(rng, wish.what)
            case "teach":
                yield from self._teach(rng)
            case "release":
                yield from self._ask(Release(self._id()), 1.0)

    def _halt(self, rng: np.random.Generator) -> Doing:
        """On its way to rest the arm is stopped."""
        yield from self._power_up(rng)
        if self._mode is Mode.HOLDING and not self._code:
            yield (Park(self._id()),)
            yield from self._wait(float(rng.uniform(0.1, 4.0)))
            yield from self._ask(Hold(self._id()), 2.0)
            yield from self._wait(1.0)

    def _teach(self, rng: np.random.Generator) -> Doing:
        yield from self._ask(Teach(self._id()), 2.0)
        if self._mode is Mode.TEACHING:
            yield from self._guide(rng)
            if rng.random() < 0.5:
                self._episode.body.hand.release()
            yield from self._ask(TeachEnd(self._id()), 2.0)
        if rng.random() < 0.5:
            self._episode.body.hand.release()

    def _run(self, rng: np.random.Generator, mixed: bool, planned: bool = False) -> Doing:
        yield from self._power_up(rng)
        if self._mode is not Mode.HOLDING or self._code:
            return
        q_now = self._commanded()
        if planned and q_now is not None:
            yield from self._plan(rng, "plan")
            return
        if rng.random() < WRONG_SHARE and q_now is not None:
            yield from self._ask(Run(self._id(), self._requests.wrong(rng, q_now)), 1.0)
            q_now = self._commanded()
        trajectory = None if q_now is None else self._requests.right(rng, q_now)
        if trajectory is None:
            return
        request = Run(self._id(), trajectory)
        if not mixed:
            yield from self._ask(request, 60.0)
            return
        yield (request,)
        for _ in range(int(rng.integers(1, 4))):
            yield from self._wait(float(rng.uniform(0.1, 3.0)))
            if self._code or request.request_id in self._replies:
                return
            yield from self._aside(rng)

    def _plan(self, rng: np.random.Generator, what: str) -> Doing:
        """Motions of all sorts, as the host takes them: it looks at each, and lets some through."""
        q_now = self._commanded()
        if self._mode is not Mode.HOLDING or self._code or q_now is None:
            return
        for _ in range(2 if what in AGAINST else 8):
            if what in AGAINST:
                trajectory = self._requests.against(rng, q_now, self._episode.plainly_wrong, AGAINST[what])
            else:
                trajectory = (self._requests.dashing if what == "dash" else self._requests.planned)(rng, q_now)
            refused = preflight_motion(
                np.array(trajectory.positions_rad),
                DrivenArm(self._arm, self._robot, trajectory.period_s),
                start_rad=q_now,
            )
            self._episode.rows["refused by the host" if refused else "let through by the host"] += 1
            if not refused:
                request = Run(self._id(), trajectory)
                self._episode.let_through(request)
                yield from self._ask(request, 60.0)
                return

    def _aside(self, rng: np.random.Generator) -> Doing:
        """Something said during a run."""
        what = rng.random()
        if what < 0.25:
            yield from self._ask(Hold(self._id()), 2.0)
        elif what < 0.6:
            yield from self._ask(SetRate(self._id(), round(float(rng.uniform(0.1, 1.0)), 2)), 1.0)
        else:
            yield from self._ask(Pause(self._id()), 1.0)
            yield from self._wait(float(rng.uniform(0.1, 2.0)))
            if self._mode is Mode.MOVING:
                yield from self._ask(Resume(self._id()), 1.0)

    def _jog(self, rng: np.random.Generator) -> Doing:
        """A heartbeat each tick, then none, or a stop."""
        yield from self._power_up(rng)
        begin = True
        for _ in range(int(rng.integers(1, 4))):
            joints, tool = self._requests.velocities(rng)
            until_s = self._now_s + float(rng.uniform(0.2, 3.0))
            while self._now_s < until_s:
                if self._code or self._mode not in (Mode.HOLDING, Mode.JOGGING):
                    return
                yield (Jog(self._id(), joints, tool, begin),)
                begin = False
        if rng.random() < 0.5:
            yield from self._ask(Hold(self._id()), 2.0)

    def _lean(self, rng: np.random.Generator, what: str) -> Doing:
        """A little way against something that holds a joint."""
        yield from self._power_up(rng)
        q_now = self._commanded()
        if self._mode is not Mode.HOLDING or self._code or q_now is None:
            return
        assert self._record is not None
        index = int(rng.integers(len(self._arm.joints)))
        least, most, held_s = LEANS[what]
        joint = self._arm.joints[index]
        tick = ax12a.register_value(ax12a.PRESENT_POSITION, self._record.inputs.sample.servos[index].registers)
        held = Fault(kind="blocked_joint", servo_id=joint.servo_id, begin_s=self._now_s, duration_s=held_s)
        self._faults.append(held)
        self._episode.fault(held)
        way = self._requests.leaning
        if what == "strain":  # a tick more or less would be too much or too little: from where the shaft really is
            way, tick = self._requests.straining, round(self._episode.watch.servos()[index].shaft_tick)
        yield from self._ask(Run(self._id(), way(q_now, index, tick, int(rng.integers(least, most)))), held_s)
        yield from self._wait(held_s)

    # ------------------------------------------------------------------------------------------ recovery

    def _recover(self) -> Doing:
        """Follow the card: wait for the faults' end, make safe, clear, and move on."""
        episode = self._episode
        while self._now_s < self._faulty_until_s() + READY_S:
            yield ()
            if not self._code:
                return
        said_s = self._now_s
        while self._code:
            code = self._code
            ended_s = self._faulty_until_s()
            if ended_s > self._now_s:  # another one has begun
                return
            yield from self._make_safe(code)
            request_id = self._id()
            yield (Clear(request_id),)
            reply = self._replies.get(request_id)
            if reply is None or not self._code or self._faulty_until_s() > self._now_s - 0.5:
                return
            if not reply.ok and self._reason() and self._now_s < said_s + PATIENCE_S:
                yield from self._wait(0.5)
                continue
            if not reply.ok:
                since_s = self._now_s - ended_s
                text = f"not cleared {since_s:.1f} s after every fault had ended: {reply.message}"
                episode.judge.found(self._now_s, "11", text)
            return
        yield from self._resume()

    def _reason(self) -> str:
        """Why a `clear` may be refused though nothing is broken any more: the arm is on its way, hot or limp."""
        if self._now_s - self._settling_since() < PATIENCE_S:
            return "on its way to rest"
        return self.persisting()

    def _settling_since(self) -> float:
        """Since when the last fault is told that may send the arm to rest."""
        assert self._record is not None
        told = [fault.since_ns / 1e9 - 1.0 for fault in self._record.outputs.faults if fault.code in RESTING]
        return max(told, default=-math.inf)

    def _make_safe(self, code: str) -> Doing:
        """What the cards ask for before `clear`."""
        body = self._episode.body
        if any(servo.temperature_degC >= self._arm.temperature_limit_degC - 1.0 for servo in body.servos):
            self._episode.fault(Fault(kind="hot", value=35.0, begin_s=self._now_s, duration_s=0.01))
            yield from self._wait(0.3)
        for index, (servo, one) in enumerate(zip(body.servos, self._arm.servos, strict=True)):
            if servo.drive.spin is not None:
                servo.set(ax12a.CW_LIMIT, one.limits_tick[0])
                servo.set(ax12a.CCW_LIMIT, one.limits_tick[1])
                self._episode.judge.mended(index)
        on = self._stiff()
        if code in ("LOST_TORQUE", "TRIPPED", "NOT_LIMP") or (any(on) and not all(on)) or self._weak():
            yield (Release(self._id()),)
            yield from self._wait(0.2)
        body.hand.release()

    def _resume(self) -> Doing:
        """The arm holds and the fault is cleared: work goes on within a second."""
        if self._mode is not Mode.HOLDING:
            return
        cleared_s = self._now_s
        q_now = self._commanded()
        if q_now is None:
            return
        goals = [servo.get(ax12a.GOAL) for servo in self._episode.body.servos]
        request_id = self._id()
        yield (Run(request_id, self._requests.going_on(q_now)),)
        while not self._code and request_id not in self._replies:
            if [servo.get(ax12a.GOAL) for servo in self._episode.body.servos] != goals:
                return
            if self._now_s - cleared_s > MOVE_S:
                if self._faulty_until_s() < cleared_s - READY_S:
                    text = "no goal moved within 1 s of a `clear` and a motion asked for"
                    self._episode.judge.found(self._now_s, "11", text)
                return
            yield ()
