"""The bench of the genetic algorithms runs every peer, and each of them works on the target."""

import numpy as np
import pytest

from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.genetic import plain
from proving import genetic_ik_bench


@pytest.mark.filterwarnings("ignore")
def test_every_solver_comes_near_its_target(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plain, "PAPER", plain.Settings(generations=60))
    result = genetic_ik_bench.bench(seed=1, targets=2, peer_targets=2, rounds=1)
    distance_mm = {row["who"]: row["value"] for row in result["rows"] if row["unit"] == "mm"}
    assert {who.split(",")[0] for who in distance_mm} == {"armctl", "DEAP", "pymoo"}
    assert all(value < 100.0 for value in distance_mm.values())
    assert distance_mm[genetic_ik_bench.OURS] < 1e-6
    assert len(result["checks"]) == 4


def test_peers_read_bits_as_the_published_algorithm_does() -> None:
    robot, wanted = robots.get("xiang-6dof"), np.array([0.2, 0.25, 0.3])
    bits = np.random.default_rng(0).integers(0, 2, (6, 64)).astype(np.float64)
    distance, q = genetic_ik_bench._distance(robot, wanted, bits)
    np.testing.assert_allclose(distance, np.linalg.norm(tool_position(robot.chain, q) - wanted, axis=1))
    value = int("".join(str(int(bit)) for bit in bits[2, 16:32]), 2)
    assert q[2, 1] == pytest.approx(-np.pi + 2.0 * np.pi * value / 65535.0)
