"""One piece of a study's work: an arm, a line and all that may be varied. Cases share nothing: anybody may run one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from armctl.config import ArmConfig
from armctl.genetic.algorithm import DEFAULT, Settings
from armctl.genetic.straight_line import StraightLineResult, optimize
from armctl.kinematics import robots
from armctl.kinematics.transform import FloatArray
from armctl.lab.course import request_of
from armctl.lab.line_experiment import Wanted
from armctl.lab.rig import VirtualRig
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC, ArmSpec
from armctl.trajectory.plan import Plan

Row = dict[str, Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class Case(Wanted):
    """What one worker gets. A study ignores the fields that it does not need.

    `repeats` may also be seeds of each setting of the genetic algorithm.
    """

    arm: ArmConfig
    period_s: float = 0.1
    # Joint positions of each recording [rad], shape (samples, joints).
    takes: tuple[FloatArray, ...] = ()
    # Of the genetic algorithm.
    settings: Settings = DEFAULT
    # How many simulated arms run what the genetic algorithm finds.
    arms: int = 0
    # Run as it stands, instead of a line that is corrected.
    plan: Plan | None = None
    # What the simulated arm is drawn from.
    spec: ArmSpec = RANDOM_SPEC
    # The effect of the simulator that is switched off.
    without: str | None = None

    def rig(self) -> VirtualRig:
        """The simulated arm of the seed, with torque on."""
        return VirtualRig(SimulatedArm(self.arm, seed=self.seed, spec=self.spec), self.period_s)

    def optimum(self, via: Sequence[int] = (), *, free: bool = False) -> StraightLineResult:
        """What the genetic algorithm makes of the takes.

        Args:
            via: Numbers of via points that a plan is wanted for.
            free: Whether genes may leave the recordings, and via points the path that was found.
        Raises:
            RequestRefused: the takes are unfit.
        """
        request = request_of(self.line, self.seed, via=tuple(via), settings=self.settings, free=free)
        return optimize(self.takes, self.arm, robots.get(self.arm.robot, self.arm.lengths_m), request)


class Found(NamedTuple):
    """What a case gave: rows of numbers, and what a page or file shows beside them."""

    rows: list[Row]
    evidence: Sequence[Any] = ()


def all_rows(found: Sequence[Found]) -> list[Row]:
    """Every row of several cases, in order."""
    return [row for one in found for row in one.rows]
