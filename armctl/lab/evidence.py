"""An experiment's plans and runs as a page shows them."""

from __future__ import annotations

import numpy as np

from armctl.kinematics.chain import tool_position
from armctl.lab import line
from armctl.lab.line import Via
from armctl.lab.rig import Measured, Rig
from armctl.report.line import LineRun, Outcome
from armctl.trajectory.plan import Plan, plan_positions

PREDICTED_POINTS = 201


def outcome(rig: Rig, found: line.Outcome) -> Outcome:
    """An experiment's outcome as a page shows it."""

    def shown(plan: Plan, measured: Measured) -> LineRun:
        return line_run(rig, found.via, plan, measured)

    return Outcome(
        via=found.via,
        before=shown(found.rounds[0].plan, found.rounds[0].measured),
        runs=[shown(found.best.plan, run) for run in found.runs or [found.best.measured]],
        rounds=[shown(one.plan, one.measured) for one in found.rounds],
    )


def line_run(rig: Rig, via: Via, plan: Plan, measured: Measured) -> LineRun:
    """One execution as a page shows it."""
    chain = rig.robot.chain
    time_s = measured.time_s
    along = plan_positions(plan, np.linspace(0.0, plan.duration_s, PREDICTED_POINTS))
    return LineRun(
        via=via,
        duration_s=measured.duration_s,
        predicted_mean_mm=plan.predicted_mean_error_mm,
        predicted_max_mm=plan.predicted_max_error_mm,
        predicted_tool_m=tool_position(chain, along[:, : chain.n]),
        via_tool_m=tool_position(chain, np.array(plan.waypoints_rad)[1:-1, : chain.n]),
        time_s=time_s,
        positions_rad=measured.positions_rad,
        goals_rad=plan_positions(plan, np.clip(time_s, 0.0, plan.duration_s)),
        tool_m=tool_position(chain, measured.positions_rad[:, : chain.n]),
        truth_time_s=measured.true_time_s,
        truth_tool_m=measured.true_tool_m,
    )
