"""What is asked of an arm, judged from the numbers of its motion alone: limits, speeds, and what it would touch.

The links are those of the simulated arm, by a product of Denavit-Hartenberg matrices that is written out here. Only
what is plain is said: bounds are wider than those that a program has to keep by what rounding and its grid may change.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Protocol

import numpy as np

from proving.reading import Arm

# Beyond these a motion is plainly wrong.
LIMIT_DEG = 0.6
SPEED_SHARE = 1.02
TOOL_SHARE = 1.05
DEEP_M = 0.004
# The path is looked at so often.
LOOK_DEG = 1.5
SAMPLES = 15


class Row(Protocol):
    """A row of a Denavit-Hartenberg table."""

    @property
    def a(self) -> float: ...

    @property
    def alpha(self) -> float: ...

    @property
    def d(self) -> float: ...

    @property
    def offset(self) -> float: ...

    @property
    def b(self) -> float: ...

    @property
    def beta(self) -> float: ...


class Chain(Protocol):
    """The links of an arm."""

    @property
    def rows(self) -> Sequence[Row]: ...

    @property
    def convention(self) -> str: ...

    @property
    def tool_m(self) -> float: ...

    @property
    def tool(self) -> Row: ...


class Motion(Protocol):
    """A motion that is asked for: a row of joint positions [rad] a period."""

    @property
    def period_s(self) -> float: ...

    @property
    def positions_rad(self) -> Sequence[Sequence[float]]: ...


class MotionJudge:
    """Judges what may be asked of one arm."""

    def __init__(self, arm: Arm, chain: Chain) -> None:
        self._arm, self._chain = arm, chain

    def plainly_wrong(self, motion: Motion) -> str:
        """Why no program may accept a run whoever asks for it; empty: nothing plain."""
        rows = np.array(motion.positions_rad)
        if not np.isfinite(rows).all() or not 0.0 < motion.period_s < math.inf:
            return "not every number of it is finite"
        return next(self._against_joints(rows, motion.period_s), "")

    def against(self, positions_rad: Sequence[Sequence[float]], period_s: float) -> Iterator[str]:
        """Why a host must not let a motion through."""
        rows = np.array(positions_rad)
        yield from self._against_joints(rows, period_s)
        tool = self.points(rows)[:, -1]
        speed_m_s = float(np.linalg.norm(np.diff(tool, axis=0), axis=1).max()) / period_s
        if speed_m_s > TOOL_SHARE * self._arm.tool_speed_limit_m_s:
            yield f"its tool reaches {speed_m_s:.3f} m/s (bound {self._arm.tool_speed_limit_m_s:g})"
        turns = np.degrees(np.abs(np.diff(rows, axis=0)).max(axis=1)).sum()
        places = np.linspace(0.0, len(rows) - 1.0, math.ceil(turns / LOOK_DEG) + 2)
        path = np.stack([np.interp(places, np.arange(len(rows)), column) for column in rows.T], axis=1)
        yield from self._against_contact(path)

    def _against_joints(self, rows: np.ndarray, period_s: float) -> Iterator[str]:
        for joint, column in zip(self._arm.joints, np.degrees(rows).T, strict=True):
            (low, high), worst = joint.limits_deg, (float(column.min()), float(column.max()))
            if worst[0] < low - LIMIT_DEG or worst[1] > high + LIMIT_DEG:
                yield f"{joint.name} goes from {worst[0]:.1f} to {worst[1]:.1f} deg (bounds {low:g} to {high:g})"
            speed = float(np.abs(np.diff(column)).max()) / period_s
            if speed > SPEED_SHARE * joint.speed_deg_s:
                yield f"{joint.name} turns at {speed:.0f} deg/s (bound {joint.speed_deg_s:g})"

    def _against_contact(self, path: np.ndarray) -> Iterator[str]:
        """Floor and links against each other; how deep the arm stands in either at the begin is allowed on its way."""
        radius_m, points = self._arm.link_radius_m, self.points(path)
        thickness = np.full(points.shape[1] - 2, radius_m)
        thickness[-1] = 0.0
        heights = points[:, 2:, 2] - thickness - self._arm.floor_m
        allowed = np.minimum(heights[0], 0.0) - DEEP_M
        if (heights < allowed).any():
            deepest_m = -float((heights - np.minimum(heights[0], 0.0)).min())
            yield f"a link comes {1000.0 * deepest_m:.0f} mm below the floor"
        ends = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[0], axis=0), axis=1))])
        share = np.linspace(0.0, 1.0, SAMPLES)[:, None]
        for i, j in combinations(range(points.shape[1] - 1), 2):
            if ends[j] - ends[i + 1] <= 2.0 * radius_m:
                continue  # neighbours touch in every pose
            one, other = (points[:, k, None] * (1.0 - share) + points[:, k + 1, None] * share for k in (i, j))
            # Sampled ones are farther apart than the links are: what is too near is so for certain.
            apart = np.linalg.norm(one[:, :, None] - other[:, None, :], axis=-1).min(axis=(1, 2)) - 2.0 * radius_m
            grid_m = 0.5 * float(ends[i + 1] - ends[i] + ends[j + 1] - ends[j]) / (SAMPLES - 1)
            begin_m = float(apart[0]) - grid_m if apart[0] < 0.0 else 0.0
            if (apart < begin_m - DEEP_M).any():
                yield f"links {i + 1} and {j + 1} come {-1000.0 * float(apart.min()):.0f} mm into each other"

    def points(self, rows: np.ndarray) -> np.ndarray:
        """Where the links end [m], shape (poses, frames, 3), base first and tool last."""
        chain = self._chain
        frame = np.broadcast_to(np.eye(4), (len(rows), 4, 4))
        found = [frame]
        for row, q in zip(chain.rows, rows.T, strict=False):
            if chain.convention == "standard":
                frame = frame @ _about_z(q + row.offset, row.d) @ _about_x(row.alpha, row.a)
            else:
                frame = frame @ _before(row) @ _about_z(q + row.offset, 0.0)
            found.append(frame)
        tool = chain.tool
        if any((chain.tool_m, tool.a, tool.alpha, tool.d, tool.offset, tool.b, tool.beta)):
            found.append(frame @ _about_x(0.0, chain.tool_m) @ _before(tool))
        return np.stack([T[:, :3, 3] for T in found], axis=1)


def _about_z(angles: np.ndarray, along_m: float) -> np.ndarray:
    T = np.tile(np.eye(4), (len(angles), 1, 1))
    T[:, 0, 0] = T[:, 1, 1] = np.cos(angles)
    T[:, 1, 0] = np.sin(angles)
    T[:, 0, 1] = -T[:, 1, 0]
    T[:, 2, 3] = along_m
    return T


def _before(row: Row) -> np.ndarray:
    """What of a modified row lies before its joint: along and about x, along y and z, about y."""
    aside = np.eye(4)
    cos, sin = math.cos(row.beta), math.sin(row.beta)
    aside[:3, :3] = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    aside[1:3, 3] = np.array([row.b, row.d])
    return np.asarray(_about_x(row.alpha, row.a) @ aside)


def _about_x(angle: float, along_m: float) -> np.ndarray:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[1, 0, 0, along_m], [0, cos, -sin, 0], [0, sin, cos, 0], [0, 0, 0, 1]], dtype=float)
