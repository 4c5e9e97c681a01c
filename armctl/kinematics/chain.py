"""Serial chains of revolute joints in Denavit-Hartenberg parameters, both conventions.

Standard:  A_i = Rz(theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)
Modified:  A_i = Rx(alpha_{i-1}) Tx(a_{i-1}) Rz(theta_i) Tz(d_i)

with theta_i = q_i + offset_i. A frame is four columns, axes X, Y, Z and origin P, of three numbers each: turning about
z mixes X and Y, twisting about x mixes Y and Z, and what a table has as zero is left out. A number is a float or, of m
poses side by side, an array of shape (m,). Products are written out (no BLAS) and summed in a fixed order, with sines
of our own, so that the same input gives the same bits for one pose and for a batch, here and on another machine.

A position q is what the joint's sensor shows. A table may tell how its link is off that: by waves of the sensor's
track, and by what gives way under the arm's weight, which is that of the posture without it.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from armctl.kinematics.transform import FloatArray, cos_sin, cos_sin_of_all

# Poses computed together: they fit the processor's cache, and the cost of a call is small beside their work.
BLOCK = 2048

# Cosine and sine of 0, 90, 180 and 270 deg.
QUARTER_TURNS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))

# The sensor of a servo repeats over its track of 300 deg: a turn of the joint is so many of its waves.
WAVES_PER_TURN = 360.0 / 300.0

# Three numbers, see above, and X, Y, Z and P of one frame.
Column = tuple[Any, Any, Any]
Frame = tuple[Column, Column, Column, Column]
BASE: Frame = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))


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
    # How far the link is off its sensor [rad]: shares of cos u, sin u, cos 2u and sin 2u, u = q * WAVES_PER_TURN.
    waves: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    # How far the weight at this row's frame bends each joint before it [rad/m]: by so much a metre of its lever.
    bend: float = 0.0

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
    # Where the base column stands in the base frame [m].
    base_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @cached_property
    def has_waves(self) -> bool:
        return any(any(row.waves) for row in self.rows)

    @cached_property
    def bends(self) -> tuple[float, ...]:
        """Of the base, of every link frame and of the tool [rad/m]; none where nothing bends."""
        bends = (0.0, *(row.bend for row in self.rows), self.tool.bend)
        return bends if any(bends) else ()

    @property
    def has_tool(self) -> bool:
        """Whether the tool frame is another than the last link frame."""
        return self.tool_m != 0.0 or self.tool != DHRow()

    @property
    def reach_m(self) -> float:
        """Bound on how far the tool is from the base."""
        return sum(abs(row.a) + abs(row.d) + abs(row.b) for row in (*self.rows, self.tool)) + abs(self.tool_m)

    @property
    def n(self) -> int:
        return len(self.rows)

    @property
    def first_axis(self) -> int:
        """The frame whose z is the first joint's axis: of joint i it is frame i - 1 (standard) or i (modified)."""
        return 0 if self.convention == "standard" else 1

    def turning(self, frames: Sequence[Any]) -> Sequence[Any]:
        """Of all frames those about whose z the joints turn."""
        return frames[self.first_axis : self.first_axis + self.n]


def _exact_cos_sin(angle: float) -> tuple[float, float]:
    """The twists of real arms are multiples of 90 deg, as near as a float comes to them: theirs are kept exact."""
    quarter = angle / (np.pi / 2.0)
    return QUARTER_TURNS[round(quarter) % 4] if abs(quarter - round(quarter)) < 1e-14 else cos_sin(angle)


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
    T = _transforms(len(flat), chain.n + 1 + chain.has_tool)
    for block in blocks(len(flat)):
        for i, frame in enumerate(_frames(chain, flat[block])):
            _write(T[block, i], frame)
    return T.reshape(*np.shape(q)[:-1], *T.shape[1:])


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
    T = _transforms(len(flat))
    for block in blocks(len(flat)):
        *_, tool = _frames(chain, flat[block])
        _write(T[block], tool)
    return T.reshape(*np.shape(q)[:-1], 4, 4)


def tool_pose(chain: SerialChain, q: Sequence[float]) -> Frame:
    """Columns X, Y, Z and P of the tool frame of one configuration, in plain floats.

    Args:
        q: Joint positions [rad], n of them.
    """
    return frames_of_one(chain, q)[-1]


def frames_of_one(chain: SerialChain, q: Sequence[float]) -> list[Frame]:
    """As `link_frames`, of one configuration, in plain floats: numpy's calls would take most of the time."""
    return list(_walked(chain, q, lambda angles: [cos_sin(angle) for angle in angles]))


def tool_position(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Tool point in the base frame [m], shape (..., 3), of joint positions q [rad], shape (..., n)."""
    flat = _flat(chain, q)
    points = np.empty((len(flat), 3))
    for block in blocks(len(flat)):
        *_, (_, _, _, P) = _frames(chain, flat[block])
        for i, number in enumerate(P):
            points[block, i] = number
    return points.reshape(*np.shape(q)[:-1], 3)


def jacobian(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Geometric Jacobian of the tool frame in the base frame, by vector products (Lu & Liu eq. 8).

    It is by the links' angles: how waves and bends change them along the way, some hundredths, is left out.

    Args:
        q: Joint positions [rad], shape (..., n).
    Returns:
        J, shape (..., 6, n): rows 0..2 velocity [m/rad], rows 3..5 angular velocity [rad/rad].
    Raises:
        ValueError: the last axis of q is not n.
    """
    flat = _flat(chain, q)
    if len(flat) == 1:
        return np.array(list(zip(*_twists(chain, flat), strict=True))).reshape(*np.shape(q)[:-1], 6, chain.n)
    J = np.empty((len(flat), 6, chain.n))
    for block in blocks(len(flat)):
        for i, twist in enumerate(_twists(chain, flat[block])):
            for k, number in enumerate(twist):
                J[block, k, i] = number
    return J.reshape(*np.shape(q)[:-1], 6, chain.n)


def _twists(chain: SerialChain, q: FloatArray) -> list[tuple[Any, ...]]:
    """The columns of the Jacobian, of six numbers each."""
    frames = list(_frames(chain, q))
    t0, t1, t2 = frames[-1][3]
    found = []
    for _, _, (z0, z1, z2), (p0, p1, p2) in chain.turning(frames):
        v0, v1, v2 = t0 - p0, t1 - p1, t2 - p2
        found.append((z1 * v2 - z2 * v1, z2 * v0 - z0 * v2, z0 * v1 - z1 * v0, z0, z1, z2))
    return found


def joint_axes(chain: SerialChain, q: FloatArray) -> tuple[list[tuple[FloatArray, FloatArray]], FloatArray]:
    """Direction and origin of every joint's axis, and the tool point, in the base frame.

    Args:
        q: Joint positions [rad], shape (m, n).
    Returns:
        n pairs (direction, origin [m]) and the tool point [m], each of shape (3, m).
    """
    frames = list(_frames(chain, q))
    filled = np.empty((len(frames), 2, 3, len(q)))
    for into, frame in zip(filled, frames, strict=True):
        for rows, column in zip(into, frame[2:], strict=True):
            rows[0], rows[1], rows[2] = column
    return [(Z, P) for Z, P in chain.turning(list(filled))], filled[-1, 1]


def cross(u: FloatArray, v: FloatArray) -> FloatArray:
    """Vector product of columns, shape (3, m); either may be (3, 1)."""
    return np.stack((u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]))


def _flat(chain: SerialChain, q: FloatArray) -> FloatArray:
    q = np.asarray(q, dtype=np.float64)
    if q.ndim == 0 or q.shape[-1] != chain.n:
        raise ValueError(f"q has shape {q.shape}; the last axis must be {chain.n}, the chain's joints")
    return q.reshape(-1, chain.n)


def _frames(chain: SerialChain, q: FloatArray) -> Iterable[Frame]:
    """The base, every link frame, and the tool frame if it is another, of q, shape (m, n)."""
    if len(q) == 1:
        return frames_of_one(chain, q[0].tolist())
    return _walked(chain, q.T, lambda angles: zip(*cos_sin_of_all(np.array(angles)), strict=True))


def _walked(chain: SerialChain, q: Iterable[Any], turns: Callable[[list[Any]], Iterable[Any]]) -> Iterable[Frame]:
    """The frames of positions that the sensors show.

    Args:
        turns: Cosine and sine of each of some angles.
    """
    if chain.has_waves:
        q = list(q)
        waves = turns([position * WAVES_PER_TURN for position in q])
        q = [at + _wave(row, *wave) for row, at, wave in zip(chain.rows, q, waves, strict=True)]
    angles = [position + row.offset for row, position in zip(chain.rows, q, strict=True)]
    frames = _product(chain, turns(angles))
    if not chain.bends:
        return frames
    bent = zip(angles, _bent(chain, list(frames)), strict=True)
    return _product(chain, turns([angle + by for angle, by in bent]))


def _wave(row: DHRow, c: Any, s: Any) -> Any:
    """How far the link is off its sensor [rad]."""
    c1, s1, c2, s2 = row.waves
    return c1 * c + s1 * s + c2 * (c * c - s * s) + s2 * (2.0 * s * c)


def _bent(chain: SerialChain, frames: Sequence[Frame]) -> Iterator[Any]:
    """How far the weight beyond each joint bends it [rad]; gravity points along -z of the base."""
    for first, (_, _, (z0, z1, _), (p0, p1, _)) in enumerate(chain.turning(frames), chain.first_axis + 1):
        beyond = zip(frames[first:], chain.bends[first:], strict=False)
        yield sum(by * (z1 * (P[0] - p0) - z0 * (P[1] - p1)) for (_, _, _, P), by in beyond)


def _product(chain: SerialChain, turns: Iterable[tuple[Any, Any]]) -> Iterator[Frame]:
    """The frames, from the cosine and sine of every joint's angle."""
    X, Y, Z, P = frame = BASE
    yield frame
    for row, (c, s) in zip(chain.rows, turns, strict=True):
        if chain.convention == "standard":
            _, a, _, d, ca, sa, *_ = row.numbers
            P = _shifted(P, Z, d) if a == 0.0 else _shifted(P, _shifted(_turned(X, Y, a * c, a * s)[0], Z, d), 1.0)
            X, Y = _turned(X, Y, c, s)
            Y, Z = _twisted(Y, Z, ca, sa)
        else:
            X, Y, Z, P = _moved(X, Y, Z, P, row)
            X, Y = _turned(X, Y, c, s)
        yield X, Y, Z, P
    if chain.has_tool:
        X, Y, Z, P = _moved(X, Y, Z, _shifted(P, X, chain.tool_m), chain.tool)
        X, Y = _twisted(X, Y, *_exact_cos_sin(chain.tool.offset))
        yield X, Y, Z, P


def _moved(X: Column, Y: Column, Z: Column, P: Column, row: DHRow) -> Frame:
    """The frame before the joint of a modified row turns."""
    _, a, b, d, ca, sa, cb, sb = row.numbers
    P = _shifted(P, X, a)
    Y, Z = _twisted(Y, Z, ca, sa)
    P = _shifted(_shifted(P, Y, b), Z, d)
    Z, X = _twisted(Z, X, cb, sb)
    return X, Y, Z, P


def _shifted(P: Column, axis: Column, length: float) -> Column:
    return P if length == 0.0 else (axis[0] * length + P[0], axis[1] * length + P[1], axis[2] * length + P[2])


def _twisted(U: Column, V: Column, c: float, s: float) -> tuple[Column, Column]:
    """Two axes turned about the third by a constant angle, mostly none or a quarter turn."""
    if s == 0.0:
        return (U, V) if c > 0.0 else (_minus(U), _minus(V))
    if c == 0.0:
        return (V, _minus(U)) if s > 0.0 else (_minus(V), U)
    return _turned(U, V, c, s)


def _minus(U: Column) -> Column:
    return -U[0], -U[1], -U[2]


def _turned(U: Column, V: Column, c: Any, s: Any) -> tuple[Column, Column]:
    (u0, u1, u2), (v0, v1, v2) = U, V
    return (c * u0 + s * v0, c * u1 + s * v1, c * u2 + s * v2), (c * v0 - s * u0, c * v1 - s * u1, c * v2 - s * u2)


def _transforms(*shape: int) -> FloatArray:
    """Of that shape, still to be filled."""
    T = np.empty((*shape, 4, 4))
    T[..., 3, :] = BASE[3] + (1.0,)
    return T


def columns_of(T: FloatArray) -> Frame:
    """The columns of transforms of shape (m, 4, 4), as frames have them: the other way round than `_write`."""
    X, Y, Z, P = (tuple(np.ascontiguousarray(T[:, :3, i].T)) for i in range(4))
    return X, Y, Z, P


def _write(T: FloatArray, frame: Frame) -> None:
    """A frame of m poses, or one for all, into transforms of shape (m, 4, 4)."""
    for k, column in enumerate(frame):
        for i, number in enumerate(column):
            T[:, i, k] = number
