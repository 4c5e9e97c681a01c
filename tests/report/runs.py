"""Runs of the line AB beside it, for the pages and pictures that are drawn of them."""

import numpy as np

from armctl.kinematics.transform import FloatArray
from armctl.report.line import LineRun

A, B = np.array([0.18, -0.1, 0.1]), np.array([0.18, 0.1, 0.1])


def beside(off_m: FloatArray) -> FloatArray:
    """A path along the line, off it by so much."""
    points: FloatArray = A + np.linspace(0.0, 1.0, 21)[:, None] * (B - A) + off_m
    return points


def run(via: int, predicted_m: FloatArray, tool_m: FloatArray, truth_m: FloatArray | None) -> LineRun:
    """A run whose tool was to be, was by the encoders, and really was on these paths."""
    time_s, angles = np.linspace(0.0, 5.0, 21), np.zeros((21, 2))
    via_m = predicted_m[1 : 1 + via]
    return LineRun(via, 5.0, 1.0, 2.0, predicted_m, via_m, time_s, angles, angles, tool_m, truth_m)
