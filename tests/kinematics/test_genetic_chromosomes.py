"""Binary chromosomes: what the bits mean, and the laws of the operators on them."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.kinematics.genetic import chromosomes
from armctl.kinematics.genetic.chromosomes import Coding, Streams, Words

RANGES = np.array([[-np.pi, np.pi], [0.0, 1.0], [-2.0, -1.0]])
codings = st.builds(Coding, st.just(RANGES), st.integers(1, 32), st.booleans())


def population(coding: Coding, runs: int, individuals: int, seed: int) -> Words:
    streams = Streams([[seed, run] for run in range(runs)])
    return chromosomes.random_words(coding, streams.uniform(individuals, coding.joints))


def bits_of(coding: Coding, words: Words) -> np.ndarray:
    """Every bit, the first joint's highest first, shape (..., length)."""
    shifts = np.arange(coding.bits - 1, -1, -1).astype(np.uint32)
    return ((words[..., None] >> shifts) & 1).reshape(*words.shape[:-1], coding.length)


@given(codings, st.integers(0, 1000))
@settings(max_examples=50)
def test_words_of_angles_of_words_are_the_words(coding: Coding, seed: int) -> None:
    words = population(coding, 2, 5, seed)
    angles = coding.angles(words)
    assert (angles >= RANGES[:, 0] - 1e-12).all()
    assert (angles <= RANGES[:, 1] + 1e-12).all()
    np.testing.assert_array_equal(coding.words(angles), words)


@given(st.integers(1, 10))
def test_neighbouring_angles_differ_in_one_bit_of_gray_code(bits: int) -> None:
    coding = Coding(RANGES[:1], bits, gray=True)
    step = 2.0 * np.pi / (2.0**bits - 1.0)
    words = coding.words(-np.pi + step * np.arange(2**bits)[:, None])
    np.testing.assert_array_equal(chromosomes.hamming(words[1:], words[:-1]), 1)


def test_the_ends_of_the_range_are_the_first_and_the_last_code() -> None:
    coding = Coding(RANGES, 16)
    np.testing.assert_array_equal(coding.angles(np.zeros(3, dtype=np.uint32)), RANGES[:, 0])
    np.testing.assert_allclose(coding.angles(np.full(3, 65535, dtype=np.uint32)), RANGES[:, 1], atol=1e-12)


@given(codings, st.integers(2, 7), st.integers(0, 1000), st.floats(0.0, 0.999))
@settings(max_examples=60)
def test_a_certain_crossover_swaps_everything_after_one_cut_and_without_a_chance_nobody_crosses(
    coding: Coding, individuals: int, seed: int, chance: float
) -> None:
    words = population(coding, 3, individuals, seed)
    pairs = individuals // 2
    cut = np.full((3, pairs), chance)
    crossing = np.full((3, pairs), chance)
    np.testing.assert_array_equal(chromosomes.cross(coding, words, crossing, cut, 0.0), words)
    children = chromosomes.cross(coding, words, crossing, cut, 1.0)
    place = 1 + int(chance * (coding.length - 1))
    before, after = bits_of(coding, words), bits_of(coding, children)
    for pair in range(pairs):
        a, b = 2 * pair, 2 * pair + 1
        np.testing.assert_array_equal(after[:, a, :place], before[:, a, :place])
        np.testing.assert_array_equal(after[:, a, place:], before[:, b, place:])
        np.testing.assert_array_equal(after[:, b, :place], before[:, b, :place])
        np.testing.assert_array_equal(after[:, b, place:], before[:, a, place:])
    if individuals % 2:
        np.testing.assert_array_equal(children[:, -1], words[:, -1])


@given(codings, st.integers(0, 1000))
@settings(max_examples=40)
def test_mutation_flips_exactly_the_bits_drawn(coding: Coding, seed: int) -> None:
    words = population(coding, 2, 4, seed)
    size = 4 * coding.length
    drawn = np.random.default_rng(seed).integers(0, size, (2, 9))
    mutated = chromosomes.mutate(coding, words, (drawn + 0.5) / size)
    flipped = bits_of(coding, words ^ mutated).reshape(2, size)
    expected = np.zeros((2, size), dtype=np.int64)
    for run in range(2):
        np.add.at(expected[run], drawn[run], 1)
    np.testing.assert_array_equal(flipped, expected % 2)
    assert chromosomes.draws(coding, 4, 0.01) == 4 + 2 * 2 + round(0.04 * coding.length)


def test_roulette_draws_in_proportion_and_never_what_has_no_fitness() -> None:
    fitness = np.array([[0.0, 3.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0]])
    drawn = chromosomes.roulette(fitness, Streams([0, 1]).uniform(8000))
    assert set(drawn[0]) == {1, 2}
    assert abs((drawn[0] == 1).mean() - 0.75) < 0.02
    assert set(drawn[1]) == {0}
    assert chromosomes.roulette(fitness, np.full((2, 1), np.nextafter(1.0, 0.0))).tolist() == [[2], [0]]


def test_a_stream_is_the_same_alone_and_among_others() -> None:
    many, alone = Streams([[0, run] for run in range(5)]), Streams([[0, 3]])
    np.testing.assert_array_equal(many.uniform(4, 2)[3], alone.uniform(4, 2)[0])
    np.testing.assert_array_equal(many.uniform(7, runs=np.array([1, 3]))[1], alone.uniform(7)[0])
