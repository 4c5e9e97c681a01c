"""An arm with two servos on its shoulder and two on its elbow."""

from typing import Any

from armctl.config import ArmConfig, validate
from armctl.files import load_arm

# Ids of the second servos, by joint; the first ones are 2 and 3.
SECOND = {"shoulder": 12, "elbow": 13}


def paired_arm(pair: dict[str, Any] | None = None, **more: Any) -> ArmConfig:
    """`ax12-line` with these pairs.

    Args:
        pair: Of the shoulder; None: it is mirrored, as that of the elbow.
        more: Keys of the shoulder.
    """
    told = load_arm("ax12-line").model_dump(mode="json", exclude_unset=True)
    for joint in told["joints"]:
        if joint["name"] in SECOND:
            joint["pair"] = {"servo_id": SECOND[joint["name"]]}
    told["joints"][1] |= more
    if pair is not None:
        told["joints"][1]["pair"] |= pair
    return validate(ArmConfig, told, "two servos on a joint")
