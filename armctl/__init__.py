"""A hardware-control daemon for Dynamixel AX-12A arms."""

__version__ = "0.1.0"
