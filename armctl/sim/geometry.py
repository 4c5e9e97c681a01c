"""How a simulated arm's true geometry differs from its file: what no encoder shows.

Rules.
1. `PERFECT` is no error at all: an arm that is drawn with it is bit for bit the one without this module.
2. Every kind of error is drawn by a random stream of its own, by the arm's seed. So no error changes what else the seed
   draws, and a level differs from another in sizes alone.
3. Angles of the shaft stay what the position sensor shows. The link deviates from it (`Deviation`). So gravity, the
   true tool and the hand see the link; the servo and its EEPROM see the shaft.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from armctl.dynamixel.ax12a import TICK_MAX, TICK_RAD
from armctl.kinematics.chain import SerialChain

# The sensor's track [rad]; its nonlinearity repeats over it, in two waves of these shares.
TRACK_RAD = TICK_MAX * TICK_RAD
WAVES = (0.7, 0.3)


@dataclass(frozen=True)
class Geometry:
    """Sizes of the errors of one assembly."""

    # Of each joint's zero: drawn evenly from within this, both ways.
    zero_deg: float = 0.0
    # Standard deviation of each link length.
    length_m: float = 0.0
    # Standard deviation of each joint axis, about the common normal to the next one.
    twist_deg: float = 0.0
    # The most by which a sensor's track is off.
    nonlinearity_deg: float = 0.0
    # How far horn and bracket bend behind the sensor.
    flex_deg_Nm: float = 0.0
    # Whole width of the play between shaft and horn.
    horn_play_deg: float = 0.0


PERFECT = Geometry()


@dataclass(slots=True, eq=False)
class Deviation:
    """How far one joint's link is from where its sensor shows the shaft; angles and torques are the servo's own."""

    amplitude_rad: float
    phases_rad: tuple[float, float]
    flex_rad_Nm: float
    half_play_rad: float
    # More than this on the link moves it through the play.
    friction_Nm: float
    # All of it, and by flex and play alone, when the link was settled last.
    settled_rad: float = 0.0
    held_rad: float = 0.0
    # Where in its play the link is, and where the shaft was then.
    _in_play_rad: float = 0.0
    _shaft_rad: float = field(default=math.nan)

    def at(self, shaft_rad: float) -> float:
        """Of the link from the shaft [rad]."""
        turn = 2.0 * math.pi * shaft_rad / TRACK_RAD
        waves = enumerate(zip(WAVES, self.phases_rad, strict=True), 1)
        wave = sum(share * math.sin(k * turn + phase) for k, (share, phase) in waves)
        return self.held_rad + self.amplitude_rad * wave

    def settle(self, shaft_rad: float, load_Nm: float) -> None:
        """Let the link follow the shaft and a torque on it; to be called at instants that the arm alone decides.

        A load pushes the link to one flank. Without one it stays where it is until the shaft takes it along.
        """
        half = self.half_play_rad
        if load_Nm > self.friction_Nm:
            self._in_play_rad = half
        elif load_Nm < -self.friction_Nm:
            self._in_play_rad = -half
        elif not math.isnan(self._shaft_rad):
            self._in_play_rad = min(max(self._in_play_rad - (shaft_rad - self._shaft_rad), -half), half)
        self._shaft_rad = shaft_rad
        self.held_rad = self._in_play_rad + self.flex_rad_Nm * load_Nm
        self.settled_rad = self.at(shaft_rad)


# Of what is drawn by a stream of its own; a new kind stands last, or every seed becomes another arm.
KINDS = "lengths", "zeros", "twists", "sensors", "stiction", "load", "dead time", "slope", "speed", "noise"


class Draws:
    """What is off about one arm, each kind from its own stream."""

    def __init__(self, geometry: Geometry, seed: int) -> None:
        self._geometry = geometry
        streams = np.random.SeedSequence((seed, 0x6E0)).spawn(len(KINDS))
        self._rng = {kind: np.random.default_rng(stream) for kind, stream in zip(KINDS, streams, strict=True)}

    def within(self, kind: str, low: float, high: float) -> float:
        """The next of a kind, drawn evenly."""
        return float(self._rng[kind].uniform(low, high))

    def share(self, kind: str, spread: float) -> float:
        """A factor that is off by up to a share, either way."""
        return 1.0 + spread * self.within(kind, -1.0, 1.0)

    def lengths_m(self, lengths_m: dict[str, float]) -> dict[str, float]:
        """The link lengths [m] as they truly are."""
        sd, rng = self._geometry.length_m, self._rng["lengths"]
        return {name: length + sd * float(rng.standard_normal()) for name, length in lengths_m.items()}

    def chain(self, chain: SerialChain) -> SerialChain:
        """The chain with its axes twisted."""
        sd, rng = math.radians(self._geometry.twist_deg), self._rng["twists"]
        rows = [replace(row, alpha=row.alpha + sd * float(rng.standard_normal())) for row in chain.rows]
        return replace(chain, rows=tuple(rows))

    def zero_rad(self) -> float:
        """By how much the next joint's zero is off."""
        return math.radians(self._geometry.zero_deg) * self.within("zeros", -1.0, 1.0)

    def deviation(self, friction_Nm: float) -> Deviation:
        """Of the next joint's link."""
        sizes = self._geometry
        first, second = self._rng["sensors"].uniform(0.0, 2.0 * math.pi, 2).tolist()
        flex_rad_Nm, half_play_rad = math.radians(sizes.flex_deg_Nm), math.radians(sizes.horn_play_deg) / 2.0
        return Deviation(math.radians(sizes.nonlinearity_deg), (first, second), flex_rad_Nm, half_play_rad, friction_Nm)
