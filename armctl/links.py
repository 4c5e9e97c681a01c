"""The links of an arm as a table of its file."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from armctl.strict_yaml import Degrees, Frozen

# No link of an arm of such servos is longer.
LONGEST_LINK_M = 2.0


def _metres(value: float) -> float:
    if abs(value) > LONGEST_LINK_M:
        raise ValueError(f"{value:g} m is beyond any arm of AX-12A (at most {LONGEST_LINK_M:g} m); give metres, not mm")
    return value


Metres = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_metres)]


# No sensor is off by more, and no bracket bends more.
Small = Annotated[float, Field(ge=-10.0, le=10.0, allow_inf_nan=False)]
NO_WAVES = (0.0, 0.0, 0.0, 0.0)
NO_OFFSET = (0.0, 0.0, 0.0)


class ChainRow(Frozen):
    """One joint of a Denavit-Hartenberg table; the joint's own angle is added to `theta_deg`."""

    # Along x to the next joint's axis; in a modified row of the link before the joint.
    a_m: Metres = 0.0
    # About x, between this joint's axis and the next; in a modified row of the link before the joint.
    alpha_deg: Degrees = 0.0
    # Along the joint's axis.
    d_m: Metres = 0.0
    # The angle of the table at joint position 0.
    theta_deg: Degrees = 0.0
    # Along y, where no convention puts the frame; of modified rows, as a URDF makes them.
    b_m: Metres = 0.0
    # About y, in the same rows.
    beta_deg: Degrees = 0.0
    # How far the joint is off what its sensor shows: shares of cos u, sin u, cos 2u and sin 2u, u being 1.2 times its
    # position; `calibrate --holding` finds them.
    waves_deg: tuple[Small, Small, Small, Small] = Field(NO_WAVES, strict=False, exclude_if=NO_WAVES.__eq__)
    # What the weight at this row's frame bends each joint before it by, a metre of lever; found likewise.
    bend_deg_m: Small = Field(0.0, exclude_if=(0.0).__eq__)


class ChainTable(Frozen):
    """The links of an arm, as a table."""

    # Which Denavit-Hartenberg convention; in a modified row `a_m` and `alpha_deg` are the link's before (Craig).
    convention: Literal["standard", "modified"]
    # One row a joint, from the base to the tool.
    dh: tuple[ChainRow, ...] = Field(min_length=1, max_length=16, strict=False)
    # The tool in the last link's frame.
    tool_m: tuple[Metres, Metres, Metres] = Field((0.0, 0.0, 0.0), strict=False)
    # Its rotation there: roll about x, pitch about y, yaw about z.
    tool_rpy_deg: tuple[Degrees, Degrees, Degrees] = Field((0.0, 0.0, 0.0), strict=False)
    # Where the base column stands: the arm may hang, or stand beside the origin of the base frame.
    base_m: tuple[Metres, Metres, Metres] = Field(NO_OFFSET, strict=False, exclude_if=NO_OFFSET.__eq__)
    # What the weight at the tool bends each joint by, as `bend_deg_m` of a row.
    tool_bend_deg_m: Small = Field(0.0, exclude_if=(0.0).__eq__)
    # The URDF that the table was made of; the table counts.
    urdf: str = ""

    def _check(self) -> None:
        for number, row in enumerate(self.dh, start=1):
            if self.convention == "standard" and (row.b_m or row.beta_deg):
                raise ValueError(f"dh row {number} has b_m or beta_deg, which are for `convention: modified`")
        if not any((*self.tool_m, *(length for row in self.dh for length in (row.a_m, row.b_m, row.d_m)))):
            raise ValueError("every length of the table is 0 m; give a_m, d_m or tool_m in metres")
