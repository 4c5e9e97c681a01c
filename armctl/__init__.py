"""A hardware-control daemon for Dynamixel AX-12A arms."""

import importlib

__version__ = "0.2.0"


def __getattr__(name: str) -> object:
    # Not before it is used, and by name: the package stands below all of its rooms. `__init__.pyi` has the types.
    if name in ("Arm", "AsyncArm"):
        return getattr(importlib.import_module("armctl.client.arm"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
