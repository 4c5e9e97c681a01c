"""The joint's steps as machine code: the same to the last bit."""

from __future__ import annotations

import importlib.util
import sys
from array import array
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain
from armctl.sim import steps
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.faults import Fault, Faults
from armctl.sim.gravity import laid_out, links_of
from armctl.sim.spec import RANDOM_SPEC
from armctl.sim.state import Seat, State
from tests.sim.conftest import sync_write

MEASURED = frozenset(r.name for r in ax12a.REGISTERS if r.name.startswith("present_")) | {"moving"}


@pytest.fixture(scope="module")
def plain() -> ModuleType:
    """The module as Python runs it, whatever has been compiled in this process."""
    spec = importlib.util.find_spec("armctl.sim.steps")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


@settings(deadline=None, max_examples=300)
@given(
    state=st.tuples(number(1.0, 4.0), number(-0.004, 0.004), st.sampled_from([0.0, 0.0, 0.3, -1.5])),
    count=st.integers(1, 40),
    ramp=st.tuples(number(400.0, 600.0), st.integers(400, 600), st.sampled_from([0.01, 0.5, 4.0])),
    load=number(-1.0, 1.0),
    ends=st.sampled_from([(-9.0, 9.0), (0.0, 5.2), (2.58, 2.62)]),
    motor=st.sampled_from([(0.0, 0.0), (1.5, 0.26), (1.3, 0.3)]),
    frozen_tick=st.sampled_from([-1, -1, -1, 500]),
    mode=st.sampled_from([(False, False), (True, False), (True, False), (True, True)]),
    pull=st.none() | st.tuples(number(1.0, 4.0), number(-1.0, 1.0), st.integers(-1, 19)),
)
def test_machine_code_gives_the_same_bits(
    plain: ModuleType,
    state: tuple[float, float, float],
    count: int,
    ramp: tuple[float, int, float],
    load: float,
    ends: tuple[float, float],
    motor: tuple[float, float],
    frozen_tick: int,
    mode: tuple[bool, bool],
    pull: tuple[float, float, int] | None,
) -> None:
    assert steps.compiled(), "numba is missing; the extra `fast` brings it"
    shaft, off, omega = state
    start, goal, way = ramp
    arrival = 0 if start == goal else int(abs(goal - start) / way) + 1
    arguments = (
        *(shaft, shaft + off, omega, 0, count),
        *(start, float(goal), way if goal > start else -way, arrival),
        *(load, 1e-3 / 0.01, 0.1, 0.12, 0.005, *ends, *motor, 0.02, 1e-4, frozen_tick),
        *(*mode, 0.3, 0.8, 32 / 1023, 1, 2, 0.03, 0.06),
        *(pull is not None, *(pull or (0.0, 0.0, 0))),
    )
    assert steps.integrate(*arguments) == plain.integrate(*arguments)


@given(number(-3000.0, 3000.0))
def test_machine_code_reads_the_same_ticks(plain: ModuleType, position_tick: float) -> None:
    assert steps.compiled()
    assert steps.sensed_tick(position_tick) == plain.sensed_tick(position_tick)


@settings(deadline=None, max_examples=300)
@given(
    shaft=number(-0.5, 6.8),
    omega=st.sampled_from([0.0, -7.0]) | number(-13.0, 13.0),
    output=number(-1.0, 1.0),
    supply=st.tuples(number(-1.0, 30.0), number(-20.0, 300.0)),
    frozen_tick=st.sampled_from([-1, -1, -1, 0, 700]),
    follows=st.booleans(),
    overloaded=st.booleans(),
    table=st.binary(min_size=ax12a.TABLE_SIZE, max_size=ax12a.TABLE_SIZE),
    noise_tick=number(-2.0, 2.0),
)
def test_machine_code_measures_the_same(
    plain: ModuleType,
    shaft: float,
    omega: float,
    output: float,
    supply: tuple[float, float],
    frozen_tick: int,
    follows: bool,
    overloaded: bool,
    table: bytes,
    noise_tick: float,
) -> None:
    assert steps.compiled()
    state = State(2)
    seat = Seat(state, 1)
    for place, value in (
        *((steps.SHAFT, shaft), (steps.OMEGA, omega), (steps.OUTPUT, output), (steps.REFERENCE, 700.0)),
        *((steps.SERVO_V, supply[0]), (steps.DEGC, supply[1])),
    ):
        state.numbers[seat.at + place] = value
    for place, whole in (
        *((steps.FROZEN, frozen_tick), (steps.FOLLOWS, follows), (steps.OVERLOADED, overloaded)),
        *((steps.MAX_DEGC, table[11]), (steps.MIN_DV, table[12]), (steps.MAX_DV, table[13])),
    ):
        state.counts[seat.of + place] = whole
    here, there = bytearray(table), bytearray(table)
    view: Any = np.frombuffer(there, np.uint8)
    numbers, counts, _ = state.views
    alarms = steps.measure(numbers, counts, view, 1, noise_tick)
    assert plain.measure(state.numbers, state.counts, here, 1, noise_tick) == alarms
    assert here == there
    for register in ax12a.REGISTERS:
        if register.name not in ("goal_position", *MEASURED):
            assert ax12a.register_value(register, bytes(here), 0) == ax12a.register_value(register, table, 0)
        elif register.name in MEASURED:
            assert register.minimum <= ax12a.register_value(register, bytes(here), 0) <= register.maximum


@settings(deadline=None, max_examples=300)
@given(
    convention=st.sampled_from(["standard", "modified"]),
    q=st.lists(number(-7.0, 7.0), min_size=5, max_size=5),
    tool_m=st.sampled_from([0.0, 0.05]),
)
def test_machine_code_weighs_the_same(plain: ModuleType, convention: str, q: list[float], tool_m: float) -> None:
    assert steps.compiled()
    rows = robots.get("ax12-line").chain.rows
    chain = SerialChain(rows, "standard" if convention == "standard" else "modified")
    there, here = (laid_out(links_of(chain), (0.07, 0.08, 0.09, 0.1, 0.11, 0.12, 0.13), tool_m) for _ in range(2))
    for i, angle in enumerate(q):
        there[steps.CHAIN_NUMBERS + i * steps.LINK_NUMBERS + steps.ANGLE] = angle
        here[steps.CHAIN_NUMBERS + i * steps.LINK_NUMBERS + steps.ANGLE] = angle
    view: Any = np.frombuffer(there)
    steps.weigh_links(view, len(q))
    plain.weigh_links(here, len(q))
    assert there == here


TROUBLE = (
    Fault(kind="blocked_joint", servo_id=2, begin_s=0.2, duration_s=6.0),
    Fault(kind="hot", servo_id=3, begin_s=4.0, value=75.0),
    Fault(kind="frozen_sensor", servo_id=4, begin_s=7.5, duration_s=1.0),
    Fault(kind="stuck_joint", servo_id=5, begin_s=8.0, duration_s=1.0),
    Fault(kind="brown_out", begin_s=9.0, duration_s=0.4, value=7.0),
)


def doubled(plain: ModuleType, name: str) -> Callable[..., Any]:
    """A method of `State` that does what it does as machine code and, on a copy of the state, without."""

    def method(state: State, *arguments: int) -> Any:
        size = 3 if name == "play" else 2
        copies = [array(each.typecode, each) for each in state.plain[:size]]
        result = getattr(steps, name)(*state.views[:size], *arguments)
        assert result == getattr(plain, name)(*copies, *arguments)
        assert [copy.tobytes() for copy in copies] == [each.tobytes() for each in state.plain[:size]]
        return result

    return method


@pytest.mark.parametrize("seed", range(6))
def test_machine_code_plays_the_same_arm(
    plain: ModuleType, arm: ArmConfig, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """Every call of twelve seconds with a hand, overload, heat, a dead motor, a dead sensor and a brown-out."""
    assert steps.compiled()
    for name in ("play", "turn", "drain", "close_chunk"):
        monkeypatch.setattr(State, name, doubled(plain, name))
    rng = np.random.default_rng(seed)
    simulated = SimulatedArm(arm, seed=seed, spec=RANDOM_SPEC, faults=Faults(TROUBLE))
    bus, now_ns = SimulatedBus(simulated), NS_PER_S
    overloaded = hot = False
    for k in range(120):
        goal_rad = np.radians([0.0, 75.0, -60.0, -45.0, -45.0, 0.0]) + 0.3 * rng.standard_normal(6)
        if k < 70 and k % 5 == 0:
            bus.receive(sync_write(arm, goal_rad.tolist(), [0 if k == 40 else 100] * 6), now_ns)
        if k == 95:
            for servo in simulated.servos:
                servo.set(ax12a.TORQUE_ENABLE, 0)
            simulated.hand.guide(np.array([0.2, 0.0, 0.1]), np.array([0.2, 0.05, 0.1]), seed=seed, duration_s=0.5)
        now_ns += int(rng.integers(80_000_000, 120_000_000))
        simulated.advance(now_ns, int(rng.integers(6)) if rng.random() < 0.5 else None)
        if rng.random() < 0.2:
            simulated.true_positions()
        overloaded |= simulated.servos[1].overloaded != 0
        hot |= simulated.servos[2].get(ax12a.TORQUE_LIMIT) == 0
    assert overloaded
    assert hot


def test_without_numba_it_runs_as_it_stands(plain: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)
    before = plain.integrate
    assert not plain.compiled()
    assert plain.integrate is before
