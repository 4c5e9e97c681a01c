"""The arm's lag model, learnt after each motion (see `trajectory/learning.py`), kept beside its calibration.

It runs in a thread, once the arm rests and before the motion is answered: the next motion has what this one taught, and
the answer tells what is not as the model says. A motion that failed, or with something in the gripper, teaches nothing;
nor does one that was not corrected, whose joints were degrees away from where the model is asked.
"""

import logging
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from armctl.clock import NS_PER_S
from armctl.commissioning import sag_file
from armctl.config import ArmConfig, Config
from armctl.errors import ConfigError
from armctl.host.watch import Done, Watch, holds
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.messages import LagModel
from armctl.trajectory import lag, learning
from armctl.trajectory.learning import Seen

logger = logging.getLogger(__name__)


class Learner:
    """What is known of one arm's lag."""

    def __init__(self, config: Config, arm: ArmConfig, robot: Robot, period_s: float) -> None:
        self._config, self.arm, self.robot, self.period_s = config, arm, robot, period_s
        self._history: sag_file.History | None = None

    def load(self) -> LagModel | None:
        """The arm's own model, as far as there is one by now.

        Raises:
            ConfigError: its file is no model.
        """
        return sag_file.load(self._config, self.arm)

    def learn(self, done: Sequence[Done]) -> str:
        """Learn from what was run, leg by leg; what is not as the model says, or nothing."""
        try:
            return self._taught(done)
        except ConfigError as error:
            logger.error("nothing is learnt of the arm's lag: %s", error)
        except Exception:  # a defect; the motion is over, and was done well
            logger.exception("nothing is learnt of the arm's lag")
        return ""

    def _taught(self, done: Sequence[Done]) -> str:
        sums: lag.Summary | None = None
        for leg in done:
            plain = not (self.arm.correction and leg.trajectory.corrected)
            if plain or leg.trajectory.grip is not None or holds(self.arm, leg.watch.load_ratio[-1]):
                return ""
            if (seen := self._seen(leg.watch)) is None:
                continue
            more = learning.sums_of(self.robot.chain, seen, self.period_s)
            sums = more if sums is None else sums + more
        return "" if sums is None else self._learnt(sums)

    def _learnt(self, sums: lag.Summary) -> str:
        history = self._history or sag_file.load_history(self._config, self.arm, self.robot.chain.n)
        present = self.load() or lag.nominal(self.arm, self.robot.chain)
        lesson = learning.learn(self.arm, self.robot.chain, history.experience(), present, sums)
        made = datetime.now(UTC).isoformat(timespec="seconds")
        self._history = history.after(lesson, made)
        if lesson.model is not None:
            sag_file.save(self._config, lesson.model, version=self._history.version, made=made)
        sag_file.save_history(self._config, self._history)
        return lesson.change

    def _seen(self, watch: Watch) -> Seen | None:
        """The motion from its first goal on; None: there was hardly any, or armctl had no say in part of it."""
        n = self.robot.chain.n
        begin = next((k for k, goal in enumerate(watch.goals) if goal), len(watch.goals))
        if len(watch.goals) - begin < learning.SAMPLES or not all(watch.wanted_rad[begin:]):
            return None
        origin_ns = watch.now_ns[begin]

        def since_s(times_ns: Sequence[object]) -> FloatArray:
            return np.asarray((np.array(times_ns[begin:], dtype=np.int64) - origin_ns) / np.float64(NS_PER_S))

        ticks = zip(*watch.goals[begin:], strict=True)
        goals = [[joint.position_rad(tick) for tick in row] for joint, row in zip(self.arm.joints, ticks, strict=True)]
        return Seen(
            due_s=since_s(watch.now_ns) + self.period_s,
            goals_rad=np.array(goals).T[:, :n],
            wanted_rad=np.array(watch.wanted_rad[begin:])[:, :n],
            read_s=since_s(watch.stamps_ns)[:, :n],
            positions_rad=np.array(watch.positions_rad[begin:])[:, :n],
            fresh=np.array(watch.fresh[begin:])[:, :n],
        )
