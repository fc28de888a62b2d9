"""The compiled random streams against NumPy's own generator, bit for bit."""

import numpy as np
import pytest
from gymnasium.utils import seeding
from hypothesis import given
from hypothesis import strategies as st

from mfc_gym import streams
from mfc_gym.env import TrackingEnv

WORD = st.integers(0, 2**64 - 1)


@given(WORD, WORD)
def test_multiply_high(a, b):
    assert int(streams.multiply_high(np.uint64(a), np.uint64(b))) == a * b >> 64


@given(st.integers(0, 2**128), st.integers(1, 50))
def test_numbers_are_those_of_numpy(seed, count):
    """For any seed, also beyond 64 bits; afterwards the generator goes on from where the stream stands."""
    generator, _ = seeding.np_random(seed)
    stream = streams.words(generator)
    drawn = [streams.random(stream) for _ in range(count)]
    expected, _ = seeding.np_random(seed)
    assert drawn == expected.random(count).tolist()
    streams.move(generator, stream)
    assert generator.bit_generator.state == expected.bit_generator.state


def test_uniform_numbers_and_keys_come_from_the_same_numbers():
    """NumPy's `uniform(low, high)` is low + (high - low) random(), its `integers(2^53)` is 2^53 random()."""
    a, b = np.random.default_rng(0), np.random.default_rng(0)
    low, high = np.array([-1.5, 0.3, 7.0]), np.array([0.1, 0.4, 1e3])
    assert (a.uniform(low, high) == low + (high - low) * b.random(3)).all()
    assert a.integers(2**53) == 2**53 * b.random()


def test_reseeding_leaves_the_others_alone():
    many = streams.ManyStreams(4)
    many.reseed(range(4), [0, 1, 2, 3])
    taken = many.take([1, 3])
    for stream in taken:
        streams.random(stream)
    many.put([1, 3], taken)
    many.reseed([0, 3], [7, None, None, None])
    numbers = [generator.random() for generator in many.generators()]
    assert numbers == [seeding.np_random(seed)[0].random(i)[-1] for seed, i in ((7, 1), (1, 2), (2, 1), (3, 2))]
    assert many.seeds() == (7, 1, 2, 3)


@pytest.mark.parametrize("bits", [np.random.PCG64, np.random.MT19937, np.random.Philox])
def test_a_users_own_generator(bits):
    """The environment draws from whatever generator it was given, reproducibly, each episode anew."""
    observations = []
    for _ in range(2):
        env = TrackingEnv(scenario="random")
        env.np_random = np.random.Generator(bits(5))
        observations.append([env.reset()[0] for _ in range(3)])
    assert np.array_equal(*observations)
    assert len(np.unique(observations[0], axis=0)) == 3
