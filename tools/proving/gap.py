"""How near the genetic algorithm comes to the exact optimum over recorded genes, in how much computing time.

Twenty arms drawn at random, each with a random line and twenty takes of the simulated hand, recorded through servos,
bus and control loop; of each set the first 5, 10, 15 and 20 takes. What counts is the cost that both searches minimise:
mean distance to the line and the charges for broken limits.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from armctl.errors import RequestRefused, UnreachableTarget
from armctl.files import load_arm
from armctl.genetic.request import OptimizeRequest
from armctl.genetic.straight_line import optimize
from armctl.kinematics.transform import FloatArray
from armctl.lab import sag_identification
from armctl.lab.rig import VirtualRig
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC

SETS = 20
SIZES = (5, 10, 15, 20)
DURATION_S = 5.0
GAP_BOUND = 0.01
COMPUTE_BOUND_S = 1.0


def prove(seed: int, tell: Callable[[str], None], sets: int = SETS, sizes: tuple[int, ...] = SIZES) -> dict[str, Any]:
    """Rows by number of recordings; a violation is a set that is missed by more than a bound."""
    found: dict[int, list[tuple[float, float, bool]]] = {size: [] for size in sizes}
    violations = []
    for number in range(sets):
        arm_seed = seed * 1000 + number
        rig, A, B, takes = _taught(arm_seed, max(sizes))
        for size in sizes:
            seconds: list[float] = []

            def now(_generation: int, _best: float, _mean: float, seconds: list[float] = seconds) -> None:
                seconds.append(time.process_time())

            began_s = time.process_time()
            result = optimize(
                takes[:size],
                rig.arm,
                rig.robot,
                OptimizeRequest(
                    from_m=tuple(A.tolist()),
                    to_m=tuple(B.tolist()),
                    via=(),
                    duration_s=DURATION_S,
                    seed=arm_seed,
                    free=False,
                ),
                now,
            )
            compute_s = seconds[-1] - began_s
            found[size].append((result.gap_ratio, compute_s, result.feasible))
            if result.gap_ratio > GAP_BOUND:
                violations.append(f"set {arm_seed}, {size} recordings: gap {result.gap_ratio:.2%}")
            if compute_s > COMPUTE_BOUND_S:
                violations.append(f"set {arm_seed}, {size} recordings: {compute_s:.2f} s of compute")
        tell(f"set {number + 1} of {sets}")
    rows = []
    for size, some in found.items():
        gaps, seconds_of, feasible = (np.array(column) for column in zip(*some, strict=True))
        rows.append(
            {
                "recordings": size,
                "gap_mean": float(gaps.mean()),
                "gap_worst": float(gaps.max()),
                "over_bound": int((gaps > GAP_BOUND).sum()),
                "compute_s_mean": float(seconds_of.mean()),
                "compute_s_worst": float(seconds_of.max()),
                "feasible": int(feasible.sum()),
            }
        )
    return {"runs": sets * len(sizes), "violations": violations, "rows": rows, "seed": seed}


def _taught(seed: int, takes: int) -> tuple[VirtualRig, FloatArray, FloatArray, list[FloatArray]]:
    """A random arm, a random line that its hand can guide along, and the takes."""
    rng = np.random.default_rng(seed)
    rig = VirtualRig(SimulatedArm(load_arm("ax12-line"), seed=seed, spec=RANDOM_SPEC))
    while True:
        A, B = sag_identification.random_line(rig, rng)
        try:
            return rig, A, B, [rig.teach(A, B, seed * 1000 + take) for take in range(takes)]
        except (UnreachableTarget, RequestRefused):
            continue
