"""Disturbances and schedules against their closed forms."""

import numpy as np
import pytest

from mfc_gym.waves import WAVES, of

DT = 0.01


def sampled(family: str, times: np.ndarray, key: float = 1.0, m: int = 4, **given: float) -> np.ndarray:
    """[d, ..., d^(m-1)] at the times, each as its own sampling interval sees it, shape (len(times), m)."""
    p = np.array(list(WAVES[family].parameters(given).values()))
    out = np.empty((len(times), m))
    for t, row in zip(times, out, strict=True):
        begin = DT * np.floor(t / DT + 1e-9)
        WAVES[family].function(begin, t - begin, DT, p, key, row)
    return out


TIMES = DT * np.arange(1000) + 0.3 * DT


def test_step() -> None:
    np.testing.assert_array_equal(sampled("step", TIMES, amplitude=2.0, time=5.0)[:, 0], 2.0 * (TIMES > 5.0))


def test_impulse() -> None:
    """Its area, whatever dt, and one interval long."""
    d = sampled("impulse", TIMES, area=0.3, time=5.004)[:, 0]
    assert np.count_nonzero(d) == 1
    assert d.sum() * DT == pytest.approx(0.3, rel=1e-12)


def test_drift() -> None:
    expected = -2.0 * np.clip((TIMES - 4.0) / 3.0, 0.0, 1.0)
    np.testing.assert_allclose(
        sampled("drift", TIMES, amplitude=-2.0, time=4.0, duration=3.0)[:, 0], expected, atol=1e-12
    )


def test_sine() -> None:
    d = sampled("sine", TIMES, amplitude=2.0, frequency=3.0, phase=0.5)
    for k in range(4):
        np.testing.assert_allclose(
            d[:, k], 2.0 * 3.0**k * np.sin(3.0 * TIMES + 0.5 + k * np.pi / 2), rtol=0, atol=1e-12 * 3**k
        )


def test_noise_has_its_strength_and_its_band() -> None:
    """The mean square over the keys is that of independent random phases at every time; nothing lies above the bandwidth."""
    d = np.array([sampled("noise", np.array([1.0]), key, rms=0.5, bandwidth=5.0)[0, 0] for key in range(4000)])
    assert np.mean(d**2) == pytest.approx(0.25, rel=5 * np.sqrt(2 / 4000))
    long = sampled("noise", DT * np.arange(40_000), rms=0.5, bandwidth=5.0)[:, 0] * np.hanning(40_000)
    power = np.abs(np.fft.rfft(long)) ** 2
    frequencies = 2 * np.pi * np.fft.rfftfreq(40_000, DT)
    assert power[frequencies > 5.1].sum() < 1e-9 * power.sum()
    phases = [sampled("noise", np.array([0.0]), key, rms=1.0)[0, 0] for key in range(500)]
    assert abs(np.mean(phases)) < 5 / np.sqrt(500)


@pytest.mark.parametrize("family", ["drift", "sine", "noise"])
def test_rates_are_derivatives(family: str) -> None:
    """Central differences within an interval, whose error is h^2 / 6 times the bound of d^(k+3)."""
    h, times = 1e-3, TIMES[::50] + 0.2 * DT
    before, now, after = (sampled(family, times + s * h) for s in (-1, 0, 1))
    p = WAVES[family].parameters({})
    for k in range(3):
        error = h**2 / 6 * WAVES[family].bound(p, k + 3, DT) + 1e-12 / h
        np.testing.assert_allclose((after - before)[:, k] / (2 * h), now[:, k + 1], rtol=0, atol=1.01 * error)


@pytest.mark.parametrize("family", WAVES)
def test_bounds_hold(family: str) -> None:
    wave, p = WAVES[family], WAVES[family].parameters({})
    d = sampled(family, TIMES)
    low, high = wave.extent(p, DT)
    assert (low - 1e-12 <= d[:, 0]).all()
    assert (d[:, 0] <= high + 1e-12).all()
    for k in range(4):
        assert np.abs(d[:, k]).max() <= wave.bound(p, k, DT) * (1 + 1e-12)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"wave": "sawtooth"}, '`disturbance` of x1 must be a dict with "wave" one of'),
        ("sine", "`disturbance` of x1 must be a dict"),
        ({"wave": "sine", "height": 1}, "`disturbance` of x1: `wave` must have parameters among"),
        (
            {"wave": "sine", "amplitude": float("nan")},
            "`disturbance` of x1: `amplitude` of a wave must be a number of at most",
        ),
        ({"wave": "drift", "duration": 0}, "`disturbance` of x1: `duration` of a wave must be positive"),
    ],
)
def test_errors(given: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        of("disturbance", "x1", given)
