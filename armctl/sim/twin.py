"""The twin of an arm that was identified: the file that `armctl identify` writes and the simulator plays."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from armctl.config import ArmConfig, Frozen, Name, validate
from armctl.errors import ConfigError
from armctl.files import read_text
from armctl.strict_yaml import parse_json

Figure = Annotated[float | None, Field(gt=0.0)]
Share = Annotated[float | None, Field(ge=0.0)]


class TwinJoint(Frozen):
    """One joint; what is None was not seen, and is drawn by the seed."""

    coulomb_Nm: Figure = None
    stiction_ratio: Figure = None
    slope_tick: Figure = None
    play_deg: Share = None
    delay_ms: Share = None
    stall_Nm: Figure = None
    no_load_rad_s: Figure = None
    load_friction: Share = None
    noise_tick: Share = None
    # How far its position is beyond what its servo and the arm's file say.
    zero_deg: Annotated[float | None, Field(ge=-20.0, le=20.0)] = None


class Twin(Frozen):
    """One arm."""

    arm_id: Name
    joints: dict[Name, TwinJoint]
    # On each axis, midway to the tool and at the tool.
    points_kg: tuple[float, ...] = Field(strict=False)
    ramp_from_reference: bool | None = None


def load_twin(path: Path, arm: ArmConfig) -> Twin:
    """The twin in a file.

    Raises:
        ConfigError: it is none, or of another arm.
    """
    found = validate(Twin, parse_json(read_text(path, "spec"), str(path), "identify the arm again"), str(path))
    if (found.arm_id, *found.joints) != (arm.arm_id, *arm.joint_names):
        problem = f"of arm {found.arm_id} with joints {', '.join(found.joints)}"
        raise ConfigError(str(path), "", problem, f"name the spec of {arm.arm_id}, or identify it")
    return found
