"""What a simulated arm is made of: every physical number, in one place.

docs/simulator.md says of each figure whether it is ROBOTIS', a study's or a guess, and what is not modelled.
"""

from dataclasses import dataclass, field, replace

from armctl.dynamixel import ax12a
from armctl.sim.geometry import PERFECT, Geometry
from armctl.sim.servo import ServoVariants


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
    # Coulomb friction at the output shaft.
    friction_Nm: tuple[float, float] = (0.08, 0.16)
    # Break-away torque over Coulomb friction.
    stiction_ratio: float = 1.2
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
    # Standard deviation of the error of each link length.
    length_error_m: float = 0.0
    # Standard deviation of a reported position.
    noise_tick: float = 0.5
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
    stall_current_A: float = 1.5
    # Where a servo's temperature settles while its motor rests.
    idle_degC: float = 30.0
    # How far above that it would settle at stall torque; as the square of the torque below.
    stall_heating_degC: float = 120.0
    # Time constant of heating and cooling.
    heating_s: float = 400.0
    # A servo is deaf for this long after its firmware restarts.
    boot_s: float = 0.3
    variants: ServoVariants = field(default_factory=ServoVariants)
    # What else is off, by streams of their own.
    geometry: Geometry = PERFECT


DEFAULT_SPEC = ArmSpec()

# Arms as different as one batch of servos and one pair of hands may make them: for experiments over many seeds.
RANDOM_SPEC = replace(DEFAULT_SPEC, mass_spread=0.15, stall_spread=0.2, zero_offset_within_tick=0.5)
