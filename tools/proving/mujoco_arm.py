"""The arm as MuJoCo sees it: the same chain and point masses, in a simulator that knows nothing of this package."""

from collections.abc import Sequence

from armctl.kinematics.chain import DHRow
from armctl.sim.gravity import GRAVITY_M_S2

SPHERE = '<inertial pos="{} {} {}" mass="{}" diaginertia="1e-12 1e-12 1e-12"/>'


def mjcf(rows: Sequence[DHRow], points_kg: Sequence[float], *, joint: str = "", wrist: bool = False) -> str:
    """A chain in standard DH parameters with a point mass on each axis, midway to the tool point, and there.

    Args:
        points_kg: As `PointMasses` wants them, shape (n + 2,).
        joint: Further attributes of every joint, MJCF.
        wrist: One more joint, about the x axis of the last frame, that turns the tool about itself.
    """
    last = len(rows) - 1
    hinge = f'<joint type="hinge" {joint} axis="{{}}"/>'
    speck = SPHERE.format(0, 0, 0, 1e-9)  # MuJoCo wants some mass in every moving body
    text = ""
    for i, row in reversed(tuple(enumerate(rows))):
        # theta and d act before a and alpha: the child's frame, seen from the turned axis.
        end = (row.a, 0.0, row.d)
        if i == last:
            half = f'<body pos="{end[0] / 2} 0 {end[2] / 2}">{SPHERE.format(0, 0, 0, points_kg[-2])}</body>'
            turn = hinge.format("1 0 0") if wrist else ""
            tool = f'<body pos="{end[0]} 0 {end[2]}">{turn}{SPHERE.format(0, 0, 0, points_kg[-1])}</body>'
            inner = half + tool
        else:
            inner = f'<body pos="{end[0]} 0 {end[2]}" euler="{row.alpha} 0 0">{text}</body>'
        # The mass on an axis rides on the link before it, whose turning about the axis it does not see.
        mass = SPHERE.format(0, 0, 0, points_kg[i])
        text = f'{mass}<body euler="0 0 {row.offset}">{hinge.format("0 0 1")}{speck}{inner}</body>'
    return (
        f'<mujoco><compiler angle="radian" balanceinertia="true"/>'
        f'<option timestep="0.001" gravity="0 0 -{GRAVITY_M_S2}"/><worldbody><body>{text}</body></worldbody></mujoco>'
    )
