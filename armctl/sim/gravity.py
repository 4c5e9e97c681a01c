"""Gravity torque and inertia about every axis of an arm that carries point masses.

Plain floats: for six joints they are several times faster than arrays.
"""

from __future__ import annotations

import math

from armctl.kinematics.chain import SerialChain

GRAVITY_M_S2 = 9.81

Link = tuple[bool, float, float, float, float, float]
"""Of a chain's row: whether its convention is modified, cos alpha, sin alpha, a, d, offset."""


def links_of(chain: SerialChain) -> tuple[Link, ...]:
    modified = chain.convention == "modified"
    return tuple((modified, math.cos(r.alpha), math.sin(r.alpha), r.a, r.d, r.offset) for r in chain.rows)


def gravity_loads(
    links: tuple[Link, ...], points_kg: tuple[float, ...], q: list[float], tool_m: float = 0.0
) -> list[tuple[float, float]]:
    """Gravity torque [N m] and inertia [kg m^2] about every axis of a chain that carries point masses.

    Gravity points along -z of the base. For the axis z_i through o_i and masses m_k at p_k beyond it, with
    v_k = z_i x (p_k - o_i): torque_i = -g sum(m_k v_k,z), inertia_i = sum(m_k |v_k|^2).

    Args:
        points_kg: Masses on each of the n axes (where a servo sits), midway between the last axis and the tool
            point, and at the tool point; shape (n + 2,).
        q: Joint positions [rad]; those beyond the chain's n are ignored.
        tool_m: How far the tool point lies along x of the last link frame.
    """
    ox = oy = oz = 0.0
    xx, xy, xz, yx, yy, yz, zx, zy, zz = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    axes = []
    for (modified, ca, sa, a, d, offset), angle in zip(links, q, strict=False):
        if modified:
            ox, oy, oz = ox + a * xx, oy + a * xy, oz + a * xz
            if sa != 0.0:
                yx, yy, yz, zx, zy, zz = (
                    ca * yx + sa * zx, ca * yy + sa * zy, ca * yz + sa * zz,
                    ca * zx - sa * yx, ca * zy - sa * yy, ca * zz - sa * yz,
                )  # fmt: skip
        axes.append((ox, oy, oz, zx, zy, zz))
        c, s = math.cos(angle + offset), math.sin(angle + offset)
        ox, oy, oz = ox + d * zx, oy + d * zy, oz + d * zz
        xx, xy, xz, yx, yy, yz = (
            c * xx + s * yx, c * xy + s * yy, c * xz + s * yz,
            c * yx - s * xx, c * yy - s * xy, c * yz - s * xz,
        )  # fmt: skip
        if not modified:
            ox, oy, oz = ox + a * xx, oy + a * xy, oz + a * xz
            if sa != 0.0:
                yx, yy, yz, zx, zy, zz = (
                    ca * yx + sa * zx, ca * yy + sa * zy, ca * yz + sa * zz,
                    ca * zx - sa * yx, ca * zy - sa * yy, ca * zz - sa * yz,
                )  # fmt: skip
    ox, oy, oz = ox + tool_m * xx, oy + tool_m * xy, oz + tool_m * xz
    points = [axis[:3] for axis in axes]
    lx, ly, lz = points[-1]
    points += [((lx + ox) / 2.0, (ly + oy) / 2.0, (lz + oz) / 2.0), (ox, oy, oz)]
    loads = []
    for i, (px, py, pz, ux, uy, uz) in enumerate(axes):
        torque = inertia = 0.0
        for (x, y, z), kg in zip(points[i + 1 :], points_kg[i + 1 :], strict=True):
            rx, ry, rz = x - px, y - py, z - pz
            vx, vy, vz = uy * rz - uz * ry, uz * rx - ux * rz, ux * ry - uy * rx
            torque -= kg * vz
            inertia += kg * (vx * vx + vy * vy + vz * vz)
        loads.append((GRAVITY_M_S2 * torque, inertia))
    return loads
