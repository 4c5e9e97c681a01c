"""Binary chromosomes: the joint angles of an arm as strings of bits, and what is done to them.

A chromosome has `bits` bits a joint, the first joint's highest bit first. They are kept as one machine word a joint,
so that operators work on whole words: a cut is a mask, a flipped bit an exclusive or, the Hamming distance a count of
ones. A population is an array (runs, individuals, joints); every run draws its random numbers from a stream of its
own, so that a run gives the same bits alone and among others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from armctl.errors import ConfigError
from armctl.kinematics.transform import FloatArray, IntArray

Words = NDArray[np.uint32]
MOST_BITS = 32
# Least and greatest value of every setting of a genetic algorithm that has a bound of its own.
BOUNDS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("population", "individuals"), (2, 100_000)),
    **dict.fromkeys(("generations", "migration_generations", "catastrophe_generations"), (1, 1_000_000)),
    **dict.fromkeys(("crossover_probability", "mutation_probability", "niche_radius", "progress"), (0, 1)),
    **dict.fromkeys(("elite_threshold", "elite_fraction"), (0, 1)),
    "populations": (1, 1000),
    "sharing": (0, 1000),
    "searches": (0, 100_000),
    "window_genes": (1, 12),
    "stall_generations": (0, 1_000_000),
}


def check_settings(settings: object, **bounds: tuple[float, float]) -> None:
    """Hold what the settings have of `BOUNDS`, and the bounds given, which depend on other settings.

    Raises:
        ConfigError: a setting is outside its bounds.
    """
    for name, (low, high) in (BOUNDS | bounds).items():
        value = getattr(settings, name, low)
        if not low <= value <= high:
            raise ConfigError("genetic algorithm", name, f"{value} is outside {low} to {high}")


@dataclass(frozen=True, eq=False)
class Coding:
    """What the bits mean."""

    # Angle of all zeros and of the last code, shape (joints, 2).
    ranges_rad: FloatArray
    # How many bits one joint has.
    bits: int
    # Neighbouring angles differ in one bit (reflected Gray code); else the plain binary number.
    gray: bool = False

    def __post_init__(self) -> None:
        check_settings(self, bits=(1, MOST_BITS))

    @property
    def joints(self) -> int:
        return len(self.ranges_rad)

    @property
    def length(self) -> int:
        """Bits of a chromosome."""
        return self.joints * self.bits

    @cached_property
    def tails(self) -> Words:
        """For each place of a cut the mask of what follows it, shape (length, joints)."""
        after = (np.arange(self.joints) + 1) * self.bits - np.arange(self.length)[:, None]
        return np.asarray((1 << np.clip(after, 0, self.bits)) - 1, dtype=np.uint32)

    def angles(self, words: Words) -> FloatArray:
        """Joint angles [rad] of chromosomes, shape (..., joints)."""
        value = words
        if self.gray:
            shift = 1
            while shift < self.bits:
                value = value ^ (value >> np.uint32(shift))
                shift *= 2
        low, high = self.ranges_rad.T
        return np.asarray(low + value * ((high - low) / (2.0**self.bits - 1.0)))


class Streams:
    """One stream of random numbers a run."""

    def __init__(self, seeds: Sequence[int | Sequence[int]]) -> None:
        self._rngs = [np.random.default_rng(seed) for seed in seeds]

    def uniform(self, *shape: int, runs: IntArray | None = None) -> FloatArray:
        """Numbers within [0, 1) for every run or those of the indices `runs`, shape (runs, *shape)."""
        rngs = self._rngs if runs is None else [self._rngs[run] for run in runs]
        drawn = np.empty((len(rngs), *shape))
        for rng, out in zip(rngs, drawn, strict=True):
            rng.random(out=out)
        return drawn


def random_words(coding: Coding, chance: FloatArray) -> Words:
    """Chromosomes from random numbers, shape (..., joints)."""
    return np.asarray(chance * 2.0**coding.bits, dtype=np.float64).astype(np.uint32)


def roulette(fitness: FloatArray, chance: FloatArray) -> IntArray:
    """In every run the individuals drawn in proportion to fitness.

    Args:
        fitness: Values >= 0, not all zero, shape (runs, individuals).
        chance: Random numbers, shape (runs, draws).
    Returns:
        Indices, shape (runs, draws).
    """
    drawn = np.empty(chance.shape, dtype=np.int64)
    for sums, chances, out in zip(fitness.cumsum(axis=1), chance, drawn, strict=True):
        out[:] = sums.searchsorted(chances * sums[-1], side="right")
    # Rounding may carry a draw up to the last sum itself.
    return np.asarray(np.minimum(drawn, fitness.shape[1] - 1))


def cross(coding: Coding, words: Words, crossing: FloatArray, cut: FloatArray, probability: float) -> Words:
    """Neighbours in the population swap all bits after one cut, each pair with `probability`.

    Args:
        words: Shape (runs, individuals, joints); an odd last individual stays alone.
        crossing, cut: Random numbers, shape (runs, pairs).
    """
    pairs = words.shape[1] // 2
    place = 1 + (cut * (coding.length - 1)).astype(np.int64)
    first, second = words[:, 0 : 2 * pairs : 2], words[:, 1 : 2 * pairs : 2]
    swapped = (first ^ second) & np.where((crossing < probability)[..., None], coding.tails[place], np.uint32(0))
    children = words.copy()
    children[:, 0 : 2 * pairs : 2] ^= swapped
    children[:, 1 : 2 * pairs : 2] ^= swapped
    return children


def draws(coding: Coding, individuals: int, mutation_probability: float) -> int:
    """How many random numbers `offspring` takes: one an individual, two a pair, one a bit that flips."""
    return individuals + 2 * (individuals // 2) + round(mutation_probability * individuals * coding.length)


def offspring(coding: Coding, words: Words, fitness: FloatArray, chance: FloatArray, crossover: float) -> Words:
    """The next generation: roulette, crossover of neighbours, flipped bits.

    Args:
        words: Shape (runs, individuals, joints).
        fitness: Shape (runs, individuals); see `roulette`.
        chance: Random numbers, shape (runs, draws).
    """
    size, pairs = words.shape[1], words.shape[1] // 2
    drawn, crossing, cut, place = np.split(chance, np.cumsum([size, pairs, pairs]), axis=1)
    chosen = words[np.arange(len(words))[:, None], roulette(fitness, drawn)]
    return mutate(coding, cross(coding, chosen, crossing, cut, crossover), place)


def mutate(coding: Coding, words: Words, place: FloatArray) -> Words:
    """Flip bits at random places of every run's population, drawn with replacement.

    Args:
        words: Shape (runs, individuals, joints).
        place: Random numbers, shape (runs, flips).
    """
    mutated = words.copy()
    bit = (place * (words.shape[1] * coding.length)).astype(np.int64)
    word = bit // coding.bits + np.arange(len(words))[:, None] * (words.shape[1] * coding.joints)
    flipped = np.uint32(1) << (coding.bits - 1 - bit % coding.bits).astype(np.uint32)
    np.bitwise_xor.at(mutated.reshape(-1), word, flipped)
    return mutated


def hamming(first: Words, second: Words) -> IntArray:
    """Number of bits in which chromosomes differ (the improved algorithm's eq. 8), shape (...)."""
    return np.asarray(np.bitwise_count(first ^ second).sum(axis=-1, dtype=np.int64))
