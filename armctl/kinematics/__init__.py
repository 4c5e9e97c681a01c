"""Kinematics of serial arms: one Denavit-Hartenberg implementation for both conventions."""
