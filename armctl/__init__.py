"""A hardware-control daemon for Dynamixel AX-12A arms."""

__version__ = "0.2.0"
