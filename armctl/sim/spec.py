"""What a simulated arm is made of: every physical number, and from `arms.yaml` how arms differ.

docs/simulator.md says of each figure whether it is ROBOTIS', a study's or a guess, and what is not modelled.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from armctl.config import parse_yaml
from armctl.dynamixel import ax12a
from armctl.sim.geometry import PERFECT, Geometry
from armctl.sim.servo import ServoVariants
from armctl.sim.twin import Twin


@dataclass(frozen=True)
class ArmSpec:
    """Every physical number of a simulated arm.

    A pair is a range from which each joint (or the tool) draws by the seed of its `SimulatedArm`.
    """

    servo_kg: float = 0.0546
    bracket_kg: float = 0.020
    tool_kg: tuple[float, float] = (0.060, 0.100)
    # Each servo with its bracket is lighter or heavier by up to this share.
    mass_spread: float = 0.0
    stall_torque_Nm: float = ax12a.STALL_TORQUE_NM
    # Each motor is weaker or stronger by up to this share.
    stall_spread: float = 0.0
    no_load_speed_rad_s: float = ax12a.NO_LOAD_SPEED_RAD_S
    # Each motor is slower or faster by up to this share.
    no_load_spread: float = 0.0
    # Coulomb friction at the output shaft.
    friction_Nm: tuple[float, float] = (0.08, 0.16)
    # What friction grows by, as a share of the torque that the gears carry.
    load_friction: tuple[float, float] = (0.0, 0.0)
    # What share of its friction a joint loses for each degree that its motor is warmer than at rest.
    friction_per_degC: float = 0.0
    # Break-away torque over Coulomb friction, and how far a joint's is from that, either way.
    stiction_ratio: float = 1.2
    stiction_spread: float = 0.0
    # From a write until the controller follows it.
    dead_time_s: tuple[float, float] = (0.0, 0.0)
    # Over what share of its compliance slope the output truly climbs.
    slope_share: tuple[float, float] = (1.0, 1.0)
    # Of motor and gears, seen from the output shaft.
    rotor_inertia_kg_m2: float = 0.002
    # Whole width of the play between motor and shaft.
    play_deg: tuple[float, float] = (0.25, 0.5)
    # How fast a pushed shaft crosses its play.
    play_speed_rad_s: float = 0.2
    # Less than this on the shaft does not move it within its play.
    shaft_friction_Nm: float = 0.01
    # Standard deviation of the error of each zero_tick; no register shows it.
    zero_offset_tick: float = 0.5
    # If given, that error is drawn evenly from within this, both ways, instead.
    zero_offset_within_tick: float | None = None
    # The second servo of a joint is off what the arm's file says by up to this, both ways; what a measured table says,
    # by `zero_offset_tick`.
    pair_offset_tick: float = 4.0
    # Standard deviation of the error of each link length.
    length_error_m: float = 0.0
    # Standard deviation of a reported position; each sensor is better or worse by up to this share.
    noise_tick: float = 0.5
    noise_spread: float = 0.0
    # The mechanical stops lie this far beyond the calibration's limits.
    stop_deg: float = 2.0
    # With every joint this near its rest pose the arm leans on something that carries its weight.
    rest_support_deg: float = 4.0
    overload_output: float = 0.8
    # A servo whose output stays over `overload_output` for this long reports an overload.
    overload_s: float = 4.0
    # At the servos while no motor works.
    supply_V: float = 12.0
    # Of supply and cables together.
    supply_ohm: float = 0.15
    # Of the cable from each servo to the next one, and of its plugs.
    cable_ohm: float = 0.0
    stall_current_A: float = 1.5
    # Where a servo's temperature settles while its motor rests.
    idle_degC: float = 30.0
    # How far above that it would settle at stall torque; as the square of the torque below.
    stall_heating_degC: float = 120.0
    # Time constant of heating and cooling.
    heating_s: float = 400.0
    # A servo is deaf for this long after its firmware restarts.
    boot_s: float = 0.3
    # Whether replies take the firmware's time, and writing the EEPROM makes a servo deaf (see bus.py).
    firmware_takes_time: bool = False
    variants: ServoVariants = field(default_factory=ServoVariants)
    # What else is off, by streams of their own.
    geometry: Geometry = PERFECT
    # The arm that it is the twin of: what was found of that one is not drawn.
    twin: Twin | None = None


DEFAULT_SPEC = ArmSpec()

# Arms as different as one batch of servos and one pair of hands may make them: for experiments over many seeds.
RANDOM_SPEC = replace(DEFAULT_SPEC, mass_spread=0.15, stall_spread=0.2, zero_offset_within_tick=0.5)

_TABLE = Path(__file__).with_name("arms.yaml")
_TOLD = parse_yaml(_TABLE.read_text(encoding="utf-8"), str(_TABLE))
# How well an arm is put together.
GEOMETRIES = TypeAdapter(dict[str, Geometry]).validate_python(_TOLD["geometries"])
_SIZES: TypeAdapter[dict[str, Any]] = TypeAdapter(dict[str, bool | float | tuple[float, float]])
_PUBLISHED = _SIZES.validate_python(_TOLD["published"])
# How a servo's age changes an arm: `new` is the arm as it was given.
AGES: dict[str, dict[str, Any]] = {"new": {}, "worn": _PUBLISHED | _SIZES.validate_python(_TOLD["worn"])}
# What switches one effect of the simulator off.
EFFECTS: dict[str, dict[str, Any]] = {name: _SIZES.validate_python(off) for name, off in _TOLD["effects"].items()}
# New servos with all that is published of them: with "worn" ones, the range that identification has to stand.
RANGE_SPEC = replace(RANDOM_SPEC, **_PUBLISHED)


def put_together(spec: ArmSpec, geometry: str, age: str, twin: Twin | None = None) -> ArmSpec:
    """The arm as well put together, and with servos as old, as asked (`GEOMETRIES`, `AGES`); or the twin of another.

    What is drawn of it stays, in other sizes.
    """
    if twin is not None:
        variants = replace(spec.variants, ramp_from_reference=twin.ramp_from_reference is not False)
        spec = replace(spec, variants=variants, zero_offset_tick=0.0, zero_offset_within_tick=None)
    return replace(spec, geometry=GEOMETRIES[geometry], **AGES[age], twin=twin)
