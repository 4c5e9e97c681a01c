"""Gravity torque and inertia about every axis of an arm that carries point masses.

Gravity points along -z of the base. For the axis z_i through o_i and masses m_k at p_k beyond it, with
v_k = z_i x (p_k - o_i): torque_i = -g sum(m_k v_k,z), inertia_i = sum(m_k |v_k|^2).

The walk along the chain is a second one beside `armctl.kinematics`, on purpose. That one makes its own sines and takes
right angles for exact, and so differs in the last bits. The motion of every simulated arm since the first version
depends on the bits of this one.
"""

import math
from collections.abc import Sequence

from armctl.kinematics.chain import SerialChain

GRAVITY_M_S2 = 9.81

Vector = tuple[float, float, float]


class PointMasses:
    """Masses on each of the n axes of a chain (where a servo sits), midway to the tool point, and at the tool point."""

    def __init__(self, chain: SerialChain, points_kg: Sequence[float]) -> None:
        """
        Args:
            points_kg: In this order, from the base on; shape (n + 2,).
        """
        self.n, self.points_kg = chain.n, tuple(points_kg)
        self._modified, self._tool_m = chain.convention == "modified", chain.tool_m
        self._rows = [(math.cos(row.alpha), math.sin(row.alpha), row.a, row.d, row.offset) for row in chain.rows]
        # Along y and about y, and the tool: none in a table of Denavit and Hartenberg.
        self._across = [(row.b, math.cos(row.beta), math.sin(row.beta)) for row in chain.rows]
        tool = chain.tool
        self._tool = (tool.a, tool.b, tool.d, math.cos(tool.alpha), math.sin(tool.alpha))

    def loads(self, q: Sequence[float]) -> list[tuple[float, float]]:
        """Gravity torque [N m] and inertia [kg m^2] about every axis at joint positions q [rad]; those beyond n are
        ignored.
        """
        axes, points = self._axes_and_points(q)
        loads = []
        for i, (ux, uy, uz) in enumerate(axes):
            ox, oy, oz = points[i]
            torque = inertia = 0.0
            for (px, py, pz), kg in zip(points[i + 1 :], self.points_kg[i + 1 :], strict=True):
                rx, ry, rz = px - ox, py - oy, pz - oz
                vx, vy, vz = uy * rz - uz * ry, uz * rx - ux * rz, ux * ry - uy * rx
                torque -= kg * vz
                inertia += kg * (vx * vx + vy * vy + vz * vz)
            loads.append((GRAVITY_M_S2 * torque, inertia))
        return loads

    def _axes_and_points(self, q: Sequence[float]) -> tuple[list[Vector], list[Vector]]:
        """Direction of every axis, and where the masses are, in the base frame."""
        x, y, z, o = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
        axes, points = [], []
        for (ca, sa, a, d, offset), (b, cb, sb), position in zip(self._rows, self._across, q, strict=False):
            if self._modified:  # first along and about x, then about and along z
                o = _beyond(o, a, x)
                y, z = _turned(y, z, ca, sa)
            if b or sb:
                o = _beyond(_beyond(o, b, y), d, z)
                z, x = _turned(z, x, cb, sb)
            axes.append(z)
            points.append(o)
            angle = position + offset
            if not (b or sb):
                o = _beyond(o, d, z)
            x, y = _turned(x, y, math.cos(angle), math.sin(angle))
            if not self._modified:
                o = _beyond(o, a, x)
                y, z = _turned(y, z, ca, sa)
        tool = _beyond(o, self._tool_m, x)
        if any(self._tool[:3]):
            a, b, d, ca, sa = self._tool
            y, z = _turned(y, z, ca, sa)
            tool = _beyond(_beyond(_beyond(tool, a, x), b, y), d, z)
        (px, py, pz), (tx, ty, tz) = points[-1], tool
        return axes, [*points, ((px + tx) / 2.0, (py + ty) / 2.0, (pz + tz) / 2.0), tool]


def _beyond(point: Vector, distance: float, direction: Vector) -> Vector:
    """The point so far in a direction."""
    (px, py, pz), (ux, uy, uz) = point, direction
    return px + distance * ux, py + distance * uy, pz + distance * uz


def _turned(u: Vector, v: Vector, c: float, s: float) -> tuple[Vector, Vector]:
    """Two axes turned in their plane, from u towards v, by the angle with this cosine and sine."""
    (ux, uy, uz), (vx, vy, vz) = u, v
    return (c * ux + s * vx, c * uy + s * vy, c * uz + s * vz), (c * vx - s * ux, c * vy - s * uy, c * vz - s * uz)
