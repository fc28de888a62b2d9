"""The random streams of the environments for compiled code: the numbers of NumPy's `Generator(PCG64)`, bit for bit.

A stream is four 64-bit words, [state (high, low), increment (high, low)]. PCG64 is O'Neill's PCG XSL RR 128/64:
PCG: A family of simple fast space-efficient statistically good algorithms for random number generation, 2014.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from mfc_gym.compiled import njit

Words = NDArray[np.uint64]
Chosen = Sequence[int] | NDArray[np.intp]

_HIGH, _LOW = np.uint64(0x2360ED051FC65DA4), np.uint64(0x4385DF649FCCF645)  # the multiplier
_11, _32, _58, _63, _64 = np.uint64(11), np.uint64(32), np.uint64(58), np.uint64(63), np.uint64(64)
_HALF = np.uint64(0xFFFFFFFF)


@njit
def multiply_high(a: np.uint64, b: np.uint64) -> np.uint64:
    """The high word of the product of two words."""
    a0, a1, b0, b1 = a & _HALF, a >> _32, b & _HALF, b >> _32
    middle = a1 * b0 + ((a0 * b0) >> _32)
    return a1 * b1 + (middle >> _32) + ((a0 * b1 + (middle & _HALF)) >> _32)


@njit
def random(stream: Words) -> float:
    """The next number of `Generator.random`, uniform in [0, 1); the stream is updated."""
    low = stream[1] * _LOW
    high = multiply_high(stream[1], _LOW) + stream[0] * _LOW + stream[1] * _HIGH
    stream[1] = low + stream[3]
    stream[0] = high + stream[2] + np.uint64(stream[1] < low)
    mixed, turn = stream[0] ^ stream[1], stream[0] >> _58
    mixed = (mixed >> turn) | (mixed << ((_64 - turn) & _63))
    return float(mixed >> _11) / 9007199254740992.0


def words(generator: np.random.Generator) -> Words:
    """Where this generator stands. One that is not PCG64 gives a seed instead."""
    bits = generator.bit_generator
    if not isinstance(bits, np.random.PCG64):
        bits = np.random.PCG64(int(generator.integers(2**63)))
    state, increment = bits.state["state"]["state"], bits.state["state"]["inc"]
    return np.array([part >> shift & 0xFFFFFFFFFFFFFFFF for part in (state, increment) for shift in (64, 0)], np.uint64)


def move(generator: np.random.Generator, stream: Words) -> None:
    """Lets a generator go on where the stream stands."""
    if isinstance(generator.bit_generator, np.random.PCG64):
        state = generator.bit_generator.state
        state["state"] = {"state": int(stream[0]) << 64 | int(stream[1]), "inc": int(stream[2]) << 64 | int(stream[3])}
        generator.bit_generator.state = state


class Source(Protocol):
    """Where the random numbers of the environments come from."""

    def take(self, chosen: Chosen) -> Words:
        """The streams of these environments, shape (m, 4)."""

    def put(self, chosen: Chosen, streams: Words) -> None:
        """They go on from here."""


class OneStream:
    """The stream of a scalar environment: its generator, asked for only when something is drawn."""

    def __init__(self, generator: Callable[[], np.random.Generator]) -> None:
        self._generator = generator

    def take(self, chosen: Chosen) -> Words:
        return words(self._generator())[None]

    def put(self, chosen: Chosen, streams: Words) -> None:
        move(self._generator(), streams[0])


class ManyStreams:
    """The streams of a vector environment: each that of a scalar environment with its seed, made when first taken."""

    def __init__(self, num_envs: int) -> None:
        self._seeds: list[int | None] = [None] * num_envs
        self._made = np.zeros(num_envs, dtype=bool)
        self._words = np.empty((num_envs, 4), dtype=np.uint64)

    def take(self, chosen: Chosen) -> Words:
        chosen = np.asarray(chosen)
        for i in chosen[~self._made[chosen]].tolist():
            generator, self._seeds[i] = seeding.np_random(self._seeds[i])
            self._words[i] = words(generator)
            self._made[i] = True
        return self._words[chosen]

    def put(self, chosen: Chosen, streams: Words) -> None:
        self._words[chosen] = streams

    def reseed(self, chosen: Chosen, seeds: Sequence[int | None]) -> None:
        """Begins the streams of these environments anew, except where the seed is None."""
        for i in chosen:
            if seeds[i] is not None:
                self._seeds[i] = seeds[i]
                self._made[i] = False

    def seeds(self) -> tuple[int | None, ...]:
        """Where each stream began."""
        self.take(np.arange(len(self._seeds)))
        return tuple(self._seeds)

    def generators(self) -> tuple[np.random.Generator, ...]:
        """Copies of the streams as NumPy's generators."""
        found = tuple(np.random.default_rng(0) for _ in self._seeds)
        for generator, stream in zip(found, self.take(np.arange(len(self._seeds))), strict=True):
            move(generator, stream)
        return found
