"""A path of the tool as people give it: points, joined by lines and circular arcs, with rounded corners.

Rules.
1. A point is reached by a line, or by an arc of a circle: one row `through` says where the arc passes, the row `arc`
   after it where it ends. A whole circle is two arcs.
2. Where a path turns at once, its direction is blended. With u the way from the corner, c half the width and w(x), x in
   [-1, 1], the smooth step from 0 to 1, the path is moved by h(u / c) c (b - a), where a and b are its directions
   before and after, and h(x) is the integral of w from -1 to -|x|. Two straight lines join with no jump of curvature.
3. h is 5/32 at most, so the rounded path stays within 5/32 c |b - a| of the other. That is where c comes from; it is
   also at most half of either side, so that every side keeps its middle. Beyond c the path is exact.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from armctl.config import Frozen, validate
from armctl.errors import ConfigError
from armctl.kinematics.transform import FloatArray
from armctl.messages import LONGEST_S
from armctl.strict_yaml import csv_table, finite, parse_json
from armctl.trajectory.bounds import Joints, Point

Kind = Literal["line", "through", "arc"]

# As many as fit into one line of the daemon's socket.
MAX_POINTS = 1000
# And as many numbers of what a refinement learnt beside them.
MOST_SHIFTS = 1600
COLUMNS = ("x_m", "y_m", "z_m")
# Of a file's coordinates: a hundredth of what the arm can tell.
DECIMALS = 6
SAME_M = 1e-6
# Of arcs: a flatter one is a line.
LARGEST_RADIUS_M = 10.0
# Directions that differ by less make no corner.
SMOOTH = 1e-6
MOST_BUMP = 5.0 / 32.0


class Learnt(Frozen):
    """What runs of a path have shown of one arm."""

    arm_id: str = Field(max_length=64)
    calibration_hash: str = Field(max_length=64)
    # Where the path begins [rad], and what is added to each joint at even times from there to its end [rad].
    begin_rad: Joints
    shift_rad: Annotated[tuple[Joints, ...], Field(min_length=2, max_length=MOST_SHIFTS, strict=False)]

    def _check(self) -> None:
        if any(len(row) != len(self.begin_rad) for row in self.shift_rad):
            raise ValueError(f"shift_rad: each row must have {len(self.begin_rad)} numbers, as begin_rad has")


class PathRequest(Frozen):
    """Tool points in the base frame, how each is reached, and how long the whole takes."""

    points_m: Annotated[tuple[Point, ...], Field(min_length=2, max_length=MAX_POINTS, strict=False)]
    # How each point is reached from the one before; empty: by lines.
    kinds: Annotated[tuple[Kind, ...], Field(max_length=MAX_POINTS, strict=False)] = ()
    # From begin to end; None: as long as it needs at a speed that suits the arm.
    duration_s: float | None = Field(None, ge=0.5, le=LONGEST_S)
    # How far a corner may be cut.
    tolerance_mm: float = Field(2.0, ge=0.1, le=50.0)
    learnt: Learnt | None = None

    def _check(self) -> None:
        kinds = self.kinds or ("line",) * len(self.points_m)
        if len(kinds) != len(self.points_m):
            raise ValueError(f"kinds: {len(kinds)} for {len(self.points_m)} points; give one for each, or none")
        if kinds[0] != "line":
            raise ValueError(f"kinds: point 1 is {kinds[0]!r}; the path begins there, so it is a line")
        for number, (this, following) in enumerate(pairwise((*kinds, "line")), 1):
            if this == "through" and following != "arc":
                raise ValueError(f"kinds: point {number} is 'through'; point {number + 1} must be 'arc', where it ends")
            if following == "arc" and this != "through":
                raise ValueError(f"kinds: point {number + 1} is 'arc'; point {number} must be 'through', on its way")
        for number, (before, after) in enumerate(pairwise(self.points_m), 2):
            if math.dist(before, after) < SAME_M:
                raise ValueError(f"points_m: point {number} repeats point {number - 1}; leave it out")
        Outline(self)


def path_from_text(text: str, file: str, **more: Any) -> PathRequest:
    """The path in comma-separated values: a header `x_m,y_m,z_m`, with `kind` where wanted, and a row a point.

    Args:
        file: Name of the file, for error messages.
        more: Other fields of the request; None: as they are.
    Raises:
        ConfigError: the table is none, or what it says is no path; names the row or field, the value and its bound.
    """
    given = {key: value for key, value in more.items() if value is not None}
    if text.startswith("{"):  # a path that was refined, as it was kept
        return validate(PathRequest, parse_json(text, file) | given, file)
    header, rows = csv_table(text, file, COLUMNS, "the first row must be x_m,y_m,z_m or x_m,y_m,z_m,kind")
    if unknown := [name for name in header if name not in (*COLUMNS, "kind")]:
        raise ConfigError(file, "header", f"unknown column {', '.join(unknown)}", "known: x_m, y_m, z_m, kind")
    points, kinds = [], []
    for where, cells in rows:
        points.append(tuple(round(finite(cells[name], file, where), DECIMALS) for name in COLUMNS))
        kinds.append(cells.get("kind") or "line")
    return validate(PathRequest, {"points_m": tuple(points), "kinds": tuple(kinds), **given}, file)


class _Line(NamedTuple):
    start: FloatArray
    along: FloatArray
    length_m: float

    def at(self, way_m: FloatArray) -> FloatArray:
        return np.asarray(self.start + way_m[:, None] * self.along)

    @property
    def directions(self) -> tuple[FloatArray, FloatArray]:
        return self.along, self.along


class _Arc(NamedTuple):
    """Part of a circle in the plane of two unit vectors: `out` to its begin, and `along`, its direction there."""

    centre: FloatArray
    out: FloatArray
    along: FloatArray
    radius_m: float
    length_m: float

    def at(self, way_m: FloatArray) -> FloatArray:
        angle = way_m[:, None] / self.radius_m
        return np.asarray(self.centre + self.radius_m * (np.cos(angle) * self.out + np.sin(angle) * self.along))

    @property
    def directions(self) -> tuple[FloatArray, FloatArray]:
        angle = self.length_m / self.radius_m
        return self.along, math.cos(angle) * self.along - math.sin(angle) * self.out


class Outline:
    """The path of a request by the way along it, 0 to `length_m`: `sharp` as it was given, `rounded` as it is gone."""

    def __init__(self, request: PathRequest) -> None:
        """
        Raises:
            ValueError: an arc's three points make no circle.
        """
        self._parts = _parts([np.array(point) for point in request.points_m], request.kinds)
        # Where each part begins, and the last one ends.
        self.knots_m: FloatArray = np.concatenate([[0.0], np.cumsum([part.length_m for part in self._parts])])
        self.length_m = float(self.knots_m[-1])
        # Way [m], half the width [m], and the change of direction of each corner.
        self.corners: list[tuple[float, float, FloatArray]] = []
        for at_m, (before, after) in zip(self.knots_m[1:], pairwise(self._parts), strict=False):
            turn = after.directions[0] - before.directions[1]
            if (size := float(np.linalg.norm(turn))) > SMOOTH:
                half_m = min(request.tolerance_mm * 1e-3 / (MOST_BUMP * size), before.length_m / 2, after.length_m / 2)
                self.corners.append((float(at_m), half_m, turn))

    def sharp(self, way_m: FloatArray) -> FloatArray:
        """Points [m], shape (k, 3), at ways [m] of shape (k,)."""
        part = np.clip(np.searchsorted(self.knots_m, way_m, "right") - 1, 0, len(self._parts) - 1)
        points = np.empty((len(way_m), 3))
        for index in np.unique(part):
            here = part == index
            points[here] = self._parts[index].at(way_m[here] - self.knots_m[index])
        return points

    def rounded(self, way_m: FloatArray) -> FloatArray:
        """The same with rounded corners."""
        points = self.sharp(way_m)
        for at_m, half_m, turn in self.corners:
            near = np.abs(way_m - at_m) < half_m
            z = (1.0 - np.abs(way_m[near] - at_m) / half_m) / 2.0
            # The integral of the smooth step 6z^5 - 15z^4 + 10z^3.
            points[near] += half_m * (2.0 * z**4 * (z * (z - 3.0) + 2.5))[:, None] * turn
        return points


def _parts(points: Sequence[FloatArray], kinds: Sequence[Kind]) -> list[_Line | _Arc]:
    parts: list[_Line | _Arc] = []
    for i in range(1, len(points)):
        kind = kinds[i] if kinds else "line"
        if kind == "line":
            step = points[i] - points[i - 1]
            length_m = float(np.linalg.norm(step))
            parts.append(_Line(points[i - 1], step / length_m, length_m))
        elif kind == "arc":
            parts.append(_arc(points[i - 2], points[i - 1], points[i], i - 1))
    return parts


def _arc(P: FloatArray, Q: FloatArray, R: FloatArray, number: int) -> _Arc:
    """The arc from P through Q to R; `number` is that of P, from 1."""
    a, b = Q - P, R - P
    normal = np.cross(a, b)
    size, points = float(np.linalg.norm(normal)), f"points_m: points {number} to {number + 2}"
    if size <= SAME_M**2:
        remedy = "make a whole circle of two arcs, and a line of kind line"
        raise ValueError(f"{points} make no arc, for they lie on one line; {remedy}")
    out = -np.cross((a @ a) * b - (b @ b) * a, normal) / (2.0 * size**2)
    radius_m = float(np.linalg.norm(out))
    if radius_m > LARGEST_RADIUS_M:
        bound = f"at most {LARGEST_RADIUS_M:g} m; make it a line"
        raise ValueError(f"{points} lie on a circle of radius {radius_m:.1f} m, {bound}")
    centre, out = P - out, out / radius_m
    along = np.cross(normal / size, out)
    angle = math.atan2(float((R - centre) @ along), float((R - centre) @ out)) % (2.0 * math.pi)
    return _Arc(centre, out, along, radius_m, radius_m * angle)
