"""Inverse kinematics by genetic algorithms on binary chromosomes, for many targets or seeds at once."""
