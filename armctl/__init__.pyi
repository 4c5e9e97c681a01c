from armctl.client.arm import Arm as Arm
from armctl.client.arm import AsyncArm as AsyncArm

__version__: str
