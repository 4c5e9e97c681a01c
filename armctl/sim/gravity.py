"""Gravity torque and inertia about every axis of an arm that carries point masses.

Gravity points along -z of the base. For the axis z_i through o_i and masses m_k at p_k beyond it, with
v_k = z_i x (p_k - o_i): torque_i = -g sum(m_k v_k,z), inertia_i = sum(m_k |v_k|^2). `steps.weigh_links` computes it.
"""

from __future__ import annotations

import math
from array import array

from armctl.kinematics.chain import SerialChain
from armctl.sim import steps

GRAVITY_M_S2 = steps.GRAVITY_M_S2

Link = tuple[bool, float, float, float, float, float]
"""Of a chain's row: whether its convention is modified, cos alpha, sin alpha, a, d, offset."""


def links_of(chain: SerialChain) -> tuple[Link, ...]:
    modified = chain.convention == "modified"
    return tuple((modified, math.cos(r.alpha), math.sin(r.alpha), r.a, r.d, r.offset) for r in chain.rows)


def laid_out(links: tuple[Link, ...], points_kg: tuple[float, ...], tool_m: float) -> array[float]:
    """A chain as `steps.weigh_links` wants it; the arguments are those of `gravity_loads`."""
    chain = array("d", (tool_m, float(links[0][0])))
    for link in links:
        chain.extend((*link[1:], *[0.0] * (steps.LINK_NUMBERS - len(link) + 1)))
    for kg in points_kg:
        chain.extend((0.0, 0.0, 0.0, kg))
    return chain


def gravity_loads(
    links: tuple[Link, ...], points_kg: tuple[float, ...], q: list[float], tool_m: float = 0.0
) -> list[tuple[float, float]]:
    """Gravity torque [N m] and inertia [kg m^2] about every axis of a chain that carries point masses.

    Args:
        points_kg: Masses on each of the n axes (where a servo sits), midway between the last axis and the tool
            point, and at the tool point; shape (n + 2,).
        q: Joint positions [rad]; those beyond the chain's n are ignored.
        tool_m: How far the tool point lies along x of the last link frame.
    """
    chain = laid_out(links, points_kg, tool_m)
    rows = [steps.CHAIN_NUMBERS + i * steps.LINK_NUMBERS for i in range(len(links))]
    for at, angle in zip(rows, q, strict=False):
        chain[at + steps.ANGLE] = angle
    steps.weigh_links(chain, len(links))
    return [(chain[at + steps.TORQUE], chain[at + steps.INERTIA]) for at in rows]
