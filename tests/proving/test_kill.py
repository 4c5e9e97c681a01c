"""The kill proof's short form, and that its judge would notice."""

import math

import numpy as np
import pytest

from proving import kill
from proving.kill import Run

TIME_S = np.arange(0.0, 1.0, 0.01)


def judged(
    turned_deg: np.ndarray[tuple[int], np.dtype[np.float64]],
    adopt_s: float = 1.0,
    kept_back_s: float = 0.0,
    waited_s: float = 0.0,
) -> Run:
    """One of six joints turns so far; the others stand still."""
    q = np.zeros((len(TIME_S), 6))
    q[:, 2] = np.radians(turned_deg)
    run = Run("control", adopt_s=adopt_s, kept_back_s=kept_back_s, waited_s=waited_s)
    kill.judge(run, q, TIME_S)
    return run


def test_an_arm_that_stops_in_time_is_in_order() -> None:
    run = judged(6.0 * np.minimum(TIME_S / 0.2, 1.0))
    assert run.violations == []
    assert run.travel_deg == pytest.approx(6.0)
    assert run.stop_ms == pytest.approx(180.0, abs=11.0)


@pytest.mark.parametrize(
    ("turned_deg", "told"),
    [
        (6.0 * np.minimum(TIME_S / 0.4, 1.0), "moved for 3"),
        (11.0 * np.minimum(TIME_S / 0.2, 1.0), "turned by 11.0 deg"),
        (np.where(TIME_S > 0.5, 0.8, 0.0), "moved by 0.80 deg from 250 ms on"),
        (np.where(abs(TIME_S - 0.6) < 0.05, 0.7, 0.0), "moved by 0.70 deg from 250 ms on"),
    ],
)
def test_an_arm_that_goes_on_too_long_too_far_or_again_is_noticed(
    turned_deg: np.ndarray[tuple[int], np.dtype[np.float64]], told: str
) -> None:
    assert any(told in violation for violation in judged(turned_deg).violations)


@pytest.mark.parametrize("adopt_s", [2.1, math.nan])
def test_late_or_no_adoption_is_noticed(adopt_s: float) -> None:
    assert any("adopted after" in violation for violation in judged(0.0 * TIME_S, adopt_s).violations)


def test_what_the_machine_kept_back_is_allowed_for_and_no_more() -> None:
    turned = 6.0 * np.minimum(TIME_S / 0.4, 1.0)
    assert judged(turned, kept_back_s=0.15).violations == []
    assert judged(turned, kept_back_s=0.05).violations != []
    assert judged(turned, waited_s=5.0).violations != []
    assert judged(0.0 * TIME_S, adopt_s=2.9, waited_s=1.0).violations == []
    assert judged(0.0 * TIME_S, adopt_s=3.1, waited_s=1.0).violations != []
    assert judged(11.0 * np.minimum(TIME_S / 0.2, 1.0), kept_back_s=0.01, waited_s=5.0).violations != []


def test_both_are_killed_and_no_daemon_loses_too_many_control_processes() -> None:
    victims = kill._victims(np.random.default_rng(5), kill.RUNS)
    assert len(victims) == kill.RUNS >= 200
    assert min(victims.count("host"), victims.count("control")) > 50
    assert "control," * (kill.CONTROLS_A_DAEMON + 1) not in ",".join(victims) + ","


@pytest.mark.pty
def test_either_process_killed_leaves_the_arm_where_it_stopped() -> None:
    result = kill.prove(seed=0, runs=2)
    assert result["runs"] == 2
    assert result["control"]["runs"] == result["host"]["runs"] == 1
    # How long things took, and what a servo that answers late is mistaken for, is judged where nothing else runs.
    unsafe = ("goal, torque", "torque went off", "answered as done", "from 250 ms on")
    assert not [told for told in result["examples"] if any(part in told for part in unsafe)]


@pytest.mark.parametrize(
    ("texts", "kept_back_s", "may", "judged_too"),
    [
        (["found with SERVO_SILENT: servo 5"], 0.17, True, False),
        (["found with SERVO_SILENT: servo 5", "torque went off"], 0.17, True, True),
        (["found with SERVO_SILENT: servo 5"], 0.09, True, True),
        (["found with SERVO_SILENT: servo 5"], 0.17, False, True),
        (["torque went off"], 0.17, True, True),
    ],
)
def test_only_servos_unheard_while_the_kernel_kept_bytes_back_are_not_judged(
    texts: list[str], kept_back_s: float, may: bool, judged_too: bool
) -> None:
    run = Run("host", violations=list(texts))
    kill.excuse(run, kept_back_s, may=may)
    assert bool(run.violations) == judged_too == (not run.unjudged)
