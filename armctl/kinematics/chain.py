"""Serial chains of revolute joints in Denavit-Hartenberg parameters, both conventions.

Standard:  A_i = Rz(theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)
Modified:  A_i = Rx(alpha_{i-1}) Tx(a_{i-1}) Rz(theta_i) Tz(d_i)

with theta_i = q_i + offset_i. A frame is four columns, axes X, Y, Z and origin P, each with the poses side by side
(shape (3, m)): turning about z mixes X and Y, twisting about x mixes Y and Z, and what a table has as zero is left
out. Products are written out elementwise (no BLAS) and summed in a fixed order, with sines of our own, so that the
same input gives the same bits for one pose and for a batch, here and on another machine.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from armctl.kinematics.transform import FloatArray, cos_sin, cos_sin_of_all

# Poses computed together: they fit the processor's cache, and the cost of a call is small beside their work.
BLOCK = 2048

# Cosine and sine of 0, 90, 180 and 270 deg.
QUARTER_TURNS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))

# X, Y, Z and P of one frame, shape (3, m); (3, 1) while every pose has the same.
Columns = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
Axis = tuple[float, float, float]


@dataclass(frozen=True)
class DHRow:
    """One row of a Denavit-Hartenberg table; lengths in metres, angles in radians."""

    a: float = 0.0
    alpha: float = 0.0
    d: float = 0.0
    offset: float = 0.0
    # Along y and about y; of modified rows alone.
    b: float = 0.0
    beta: float = 0.0

    @cached_property
    def numbers(self) -> tuple[float, ...]:
        """offset, a, b, d, and the cosine and sine of alpha and of beta."""
        return self.offset, self.a, self.b, self.d, *_exact_cos_sin(self.alpha), *_exact_cos_sin(self.beta)


@dataclass(frozen=True)
class SerialChain:
    """A Denavit-Hartenberg table and its convention."""

    rows: tuple[DHRow, ...]
    convention: Literal["standard", "modified"] = "standard"
    # How far the tool frame lies along x of the last link frame: the fixed last row of a modified table.
    tool_m: float = 0.0
    # Where the tool frame lies if it is anywhere else: a fixed modified row after the last one.
    tool: DHRow = DHRow()

    @property
    def has_tool(self) -> bool:
        """Whether the tool frame is another than the last link frame."""
        return self.tool_m != 0.0 or self.tool != DHRow()

    @property
    def reach_m(self) -> float:
        """Bound on how far the tool is from the base."""
        rows = sum(abs(row.a) + abs(row.d) + abs(row.b) for row in (*self.rows, self.tool))
        return rows + abs(self.tool_m)

    @property
    def n(self) -> int:
        return len(self.rows)

    @property
    def first_axis(self) -> int:
        """The frame whose z is the first joint's axis: of joint i it is frame i - 1 (standard) or i (modified)."""
        return 0 if self.convention == "standard" else 1

    @cached_property
    def _offsets(self) -> FloatArray:
        """Shape (n, 1)."""
        return np.array([[row.offset] for row in self.rows])


def _exact_cos_sin(angle: float) -> tuple[float, float]:
    """The twists of real arms are multiples of 90 deg, as near as a float comes to them: theirs are kept exact."""
    quarter = angle / (np.pi / 2.0)
    exact = abs(quarter - round(quarter)) < 1e-14
    return QUARTER_TURNS[round(quarter) % 4] if exact else cos_sin(angle)


def blocks(count: int, size: int = BLOCK) -> Iterator[slice]:
    """Slices that take `count` rows, `size` at a time."""
    for begin in range(0, count, size):
        yield slice(begin, begin + size)


def link_frames(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Pose of the base (index 0), of every link frame and of the tool in the base frame.

    Args:
        q: Joint positions [rad], shape (..., n).
    Returns:
        T_base_link, shape (..., n + 1, 4, 4), or (..., n + 2, 4, 4) where the tool is not the last link frame.
    Raises:
        ValueError: the last axis of q is not n.
    """
    flat = _flat(chain, q)
    count = chain.n + 1 + chain.has_tool
    T = np.zeros((len(flat), count, 4, 4))
    T[:, :, 3, 3] = 1.0
    T[:, 0, :, :] = np.eye(4)
    for block in blocks(len(flat)):
        for i, columns in enumerate(_frames(chain, flat[block])):
            _write(T[block, i + 1], columns)
    return T.reshape(*np.shape(q)[:-1], count, 4, 4)


def forward_kinematics(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Tool pose in the base frame.

    Product of the link transforms, Raharjo et al. eq. (6).

    Args:
        q: Joint positions [rad], shape (..., n).
    Returns:
        T_base_tool, shape (..., 4, 4); translation in metres.
    Raises:
        ValueError: the last axis of q is not n.
    """
    flat = _flat(chain, q)
    T = np.empty((len(flat), 4, 4))
    T[:, 3, :] = (0.0, 0.0, 0.0, 1.0)
    for block in blocks(len(flat)):
        *_, tool = _frames(chain, flat[block])
        _write(T[block], tool)
    return T.reshape(*np.shape(q)[:-1], 4, 4)


def tool_pose(chain: SerialChain, q: Sequence[float]) -> tuple[Axis, Axis, Axis, Axis]:
    """Columns X, Y, Z and P of the tool frame of one configuration, in plain floats.

    Args:
        q: Joint positions [rad], n of them.
    """
    return _frames_of_one(chain, q)[-1]


def tool_position(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Tool point in the base frame [m], shape (..., 3), of joint positions q [rad], shape (..., n)."""
    flat = _flat(chain, q)
    if len(flat) == 1:
        return np.array(_frames_of_one(chain, flat[0].tolist())[-1][3]).reshape(*np.shape(q)[:-1], 3)
    points = np.empty((len(flat), 3))
    for block in blocks(len(flat)):
        *_, (_, _, _, P) = _frames(chain, flat[block])
        points[block] = P.T
    return points.reshape(*np.shape(q)[:-1], 3)


def jacobian(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Geometric Jacobian of the tool frame in the base frame, by vector products (Lu & Liu eq. 8).

    Args:
        q: Joint positions [rad], shape (..., n).
    Returns:
        J, shape (..., 6, n): rows 0..2 velocity [m/rad], rows 3..5 angular velocity [rad/rad].
    Raises:
        ValueError: the last axis of q is not n.
    """
    flat = _flat(chain, q)
    if len(flat) == 1:
        return np.array(_jacobian_of_one(chain, flat[0].tolist())).reshape(*np.shape(q)[:-1], 6, chain.n)
    J = np.empty((len(flat), 6, chain.n))
    for block in blocks(len(flat)):
        axes, tool = joint_axes(chain, flat[block])
        for i, (z, origin) in enumerate(axes):
            J[block, :3, i] = cross(z, tool - origin).T
            J[block, 3:, i] = z.T
    return J.reshape(*np.shape(q)[:-1], 6, chain.n)


def joint_axes(chain: SerialChain, q: FloatArray) -> tuple[list[tuple[FloatArray, FloatArray]], FloatArray]:
    """Direction and origin of every joint's axis, and the tool point, in the base frame.

    Args:
        q: Joint positions [rad], shape (m, n).
    Returns:
        n pairs (direction, origin [m]) and the tool point [m], each of shape (3, m) or, where all are equal, (3, 1).
    """
    frames = [_BASE, *_frames(chain, q)]
    return [(Z, P) for _, _, Z, P in frames[chain.first_axis : chain.first_axis + chain.n]], frames[-1][3]


def cross(u: FloatArray, v: FloatArray) -> FloatArray:
    """Vector product of columns, shape (3, m); either may be (3, 1)."""
    return np.stack((u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]))


_BASE: Columns = (
    np.array([[1.0], [0.0], [0.0]]),
    np.array([[0.0], [1.0], [0.0]]),
    np.array([[0.0], [0.0], [1.0]]),
    np.zeros((3, 1)),
)


_BASE_OF_ONE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))


def _flat(chain: SerialChain, q: FloatArray) -> FloatArray:
    q = np.asarray(q, dtype=np.float64)
    if q.ndim == 0 or q.shape[-1] != chain.n:
        raise ValueError(f"q has shape {q.shape}; the last axis must be {chain.n}, the chain's joints")
    return q.reshape(-1, chain.n)


def _frames(chain: SerialChain, q: FloatArray) -> Iterator[Columns]:
    """Every link frame, and the tool frame if it is another, of q, shape (m, n)."""
    X, Y, Z, P = _BASE
    cosines, sines = cos_sin_of_all(np.ascontiguousarray(q.T) + chain._offsets)
    for row, c, s in zip(chain.rows, cosines, sines, strict=True):
        if chain.convention == "standard":
            _, a, _, d, ca, sa, *_ = row.numbers
            if a != 0.0:
                along = X * (a * c) + Y * (a * s)
                P = (along if d == 0.0 else along + Z * d) + P
            elif d != 0.0:
                P = Z * d + P
            X, Y = X * c + Y * s, Y * c - X * s
            Y, Z = _twist(Y, Z, ca, sa)
        else:
            X, Y, Z, P = _moved(X, Y, Z, P, row)
            X, Y = X * c + Y * s, Y * c - X * s
        yield X, Y, Z, P
    if chain.has_tool:
        yield _tool(chain, X, Y, Z, P)


def _tool(chain: SerialChain, X: FloatArray, Y: FloatArray, Z: FloatArray, P: FloatArray) -> Columns:
    """The tool frame, from the last link frame."""
    X, Y, Z, P = _moved(X, Y, Z, X * chain.tool_m + P, chain.tool)
    c, s = _exact_cos_sin(chain.tool.offset)
    return (X, Y, Z, P) if s == 0.0 and c > 0.0 else (X * c + Y * s, Y * c - X * s, Z, P)


def _moved(X: FloatArray, Y: FloatArray, Z: FloatArray, P: FloatArray, row: DHRow) -> Columns:
    """The frame before the joint of a modified row turns."""
    _, a, b, d, ca, sa, cb, sb = row.numbers
    if a != 0.0:
        P = X * a + P
    Y, Z = _twist(Y, Z, ca, sa)
    if b != 0.0:
        P = Y * b + P
    if d != 0.0:
        P = Z * d + P
    Z, X = _twist(Z, X, cb, sb)
    return X, Y, Z, P


def _twist(Y: FloatArray, Z: FloatArray, ca: float, sa: float) -> tuple[FloatArray, FloatArray]:
    """Turn Y and Z about x."""
    if sa == 0.0:
        return (Y, Z) if ca > 0.0 else (-Y, -Z)
    if ca == 0.0:
        return (Z, -Y) if sa > 0.0 else (-Z, Y)
    return ca * Y + sa * Z, ca * Z - sa * Y


def _frames_of_one(chain: SerialChain, q: Sequence[float]) -> list[tuple[Axis, Axis, Axis, Axis]]:
    """The base and the frames of one configuration q, n joint positions, in plain floats.

    The control step asks for one pose every tick, and for so little work numpy's calls take most of the time. Same
    products in the same order as `_frames`, hence the same bits, but for the sign of a zero.
    """
    (x0, x1, x2), (y0, y1, y2), (z0, z1, z2), (p0, p1, p2) = frame = _BASE_OF_ONE
    frames = [frame]
    standard = chain.convention == "standard"
    for row, angle in zip(chain.rows, q, strict=True):
        offset, a, b, d, ca, sa, cb, sb = row.numbers
        c, s = cos_sin(angle + offset)
        twisted = sa != 0.0 or ca < 0.0
        if standard and a != 0.0:
            ac, as_ = a * c, a * s
            l0, l1, l2 = x0 * ac + y0 * as_, x1 * ac + y1 * as_, x2 * ac + y2 * as_
            if d != 0.0:
                l0, l1, l2 = l0 + z0 * d, l1 + z1 * d, l2 + z2 * d
            p0, p1, p2 = l0 + p0, l1 + p1, l2 + p2
        else:
            if a != 0.0:
                p0, p1, p2 = x0 * a + p0, x1 * a + p1, x2 * a + p2
            if twisted and not standard:
                y0, z0 = ca * y0 + sa * z0, ca * z0 - sa * y0
                y1, z1 = ca * y1 + sa * z1, ca * z1 - sa * y1
                y2, z2 = ca * y2 + sa * z2, ca * z2 - sa * y2
            if b != 0.0 and not standard:
                p0, p1, p2 = y0 * b + p0, y1 * b + p1, y2 * b + p2
            if d != 0.0:
                p0, p1, p2 = z0 * d + p0, z1 * d + p1, z2 * d + p2
            if (sb != 0.0 or cb < 0.0) and not standard:
                z0, x0 = cb * z0 + sb * x0, cb * x0 - sb * z0
                z1, x1 = cb * z1 + sb * x1, cb * x1 - sb * z1
                z2, x2 = cb * z2 + sb * x2, cb * x2 - sb * z2
        x0, y0 = x0 * c + y0 * s, y0 * c - x0 * s
        x1, y1 = x1 * c + y1 * s, y1 * c - x1 * s
        x2, y2 = x2 * c + y2 * s, y2 * c - x2 * s
        if twisted and standard:
            y0, z0 = ca * y0 + sa * z0, ca * z0 - sa * y0
            y1, z1 = ca * y1 + sa * z1, ca * z1 - sa * y1
            y2, z2 = ca * y2 + sa * z2, ca * z2 - sa * y2
        frames.append(((x0, x1, x2), (y0, y1, y2), (z0, z1, z2), (p0, p1, p2)))
    if chain.has_tool:
        X, Y, Z, P = (tuple(column.tolist()) for column in _tool(chain, *map(np.array, frames[-1])))
        frames.append((X, Y, Z, P))
    return frames


def _jacobian_of_one(chain: SerialChain, q: Sequence[float]) -> list[list[float]]:
    """Rows of the Jacobian at q, n joint positions; see `joint_axes` for the axes."""
    frames = _frames_of_one(chain, q)
    t0, t1, t2 = frames[-1][3]
    columns = []
    for _, _, (z0, z1, z2), (p0, p1, p2) in frames[chain.first_axis : chain.first_axis + chain.n]:
        v0, v1, v2 = t0 - p0, t1 - p1, t2 - p2
        columns.append((z1 * v2 - z2 * v1, z2 * v0 - z0 * v2, z0 * v1 - z1 * v0, z0, z1, z2))
    return [list(row) for row in zip(*columns, strict=True)]


def _write(T: FloatArray, columns: Columns) -> None:
    """Columns of shape (3, m) into transforms of shape (m, 4, 4)."""
    for i, column in enumerate(columns):
        T[:, :3, i] = column.T
