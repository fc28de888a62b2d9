"""Every reference against its closed form, and each of its derivatives against the next."""

from math import comb, pi

import numpy as np
import pytest
import sympy as sp
from numpy.typing import NDArray
from scipy.special import betainc

from mfc_gym import references
from mfc_gym.references import REFERENCES, Reference

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
ORDER = 6
FAMILIES = pytest.mark.parametrize("family", REFERENCES.values(), ids=REFERENCES)
t = sp.Symbol("t", real=True)


def steps(count: int, duration: float) -> Array:
    return np.linspace(0, duration, count)


def bound_of_sines(p: Array, times: Array, order: int) -> Array:
    """Of the rounding error of y^(k) for y = sum A sin(w t + q): the phase is off by 2 eps (w t + q), and 2 k + 4
    operations follow; shape (len(times), order + 1). `p` has rows (A, w, q)."""
    A, w, q = np.abs(p).T[:, :, None, None]
    k, time = np.arange(order + 1)[None, None, :], np.abs(times)[None, :, None]
    return (A * w**k * EPS * (2 * (w * time + q) + 2 * k + 4)).sum(axis=0)


# -- closed forms -----------------------------------------------------------------------------------------------------


def test_constant() -> None:
    np.testing.assert_array_equal(REFERENCES["constant"].evaluate(3.0, np.array([0.7]), 3), [0.7, 0, 0, 0])


@pytest.mark.parametrize("seed", range(3))
def test_sine(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, w, q, c = p = rng.uniform(-3, 3, 4)
    times, k = steps(50, 20), np.arange(ORDER + 1)
    got = REFERENCES["sine"].evaluate(times, p, ORDER)
    expected = A * w**k * np.sin(w * times[:, None] + q + k * pi / 2) + c * (k == 0)
    assert (np.abs(got - expected) <= 2 * bound_of_sines(p[None, :3], times, ORDER) + 2 * EPS * abs(c)).all()


@pytest.mark.parametrize("seed", range(3))
def test_multisine(seed: int) -> None:
    """The offset and the sum of its three sines."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(-2, 2, 10)
    times, k = steps(50, 20), np.arange(ORDER + 1)
    got = REFERENCES["multisine"].evaluate(times, p, ORDER)
    rows = p[1:].reshape(3, 3)
    parts = [A * w**k * np.sin(w * times[:, None] + q + k * pi / 2) for A, w, q in rows]
    expected = sum(parts) + p[0] * (k == 0)
    assert (np.abs(got - expected) <= 2 * bound_of_sines(rows, times, ORDER) + 4 * EPS * abs(p[0])).all()


@pytest.mark.parametrize("seed", range(3))
def test_chirp(seed: int) -> None:
    """Against SymPy to 30 digits. Rounding: the phase is off by 4 eps phi, and what the recursion adds up obeys the
    recursion with absolute values."""
    rng = np.random.default_rng(seed)
    A, w, r, c = p = rng.uniform(0.1, 2, 4)
    y = sp.Rational(c) + sp.Rational(A) * sp.sin(sp.Rational(w) * t + sp.Rational(r) * t**2 / 2)
    formulas = [sp.diff(y, t, k) for k in range(ORDER + 1)]
    for time in rng.uniform(0, 10, 5):
        got = REFERENCES["chirp"].evaluate(time, p, ORDER)
        phi, speed, sizes = w * time + r * time**2 / 2, w + r * time, [0.0, A]
        for k in range(ORDER):
            sizes.append(speed * sizes[-1] + k * r * sizes[-2])
        for k, formula in enumerate(formulas):
            exact = float(formula.subs(t, sp.Rational(time)).evalf(30))
            assert abs(got[k] - exact) <= EPS * ((4 * phi + 4 * k + 4) * sizes[k + 1] + c * (k == 0))


def smooth_step(n: int) -> sp.Expr:
    """s^(n+1) sum_(k=0..n) binom(n+k, k) (1-s)^k in s = t."""
    return t ** (n + 1) * sp.Add(*(comb(n + k, k) * (1 - t) ** k for k in range(n + 1)))


@pytest.mark.parametrize("n", range(1, 8))
def test_step_polynomial(n: int) -> None:
    """The theorem behind it: from 0 to 1 with n vanishing derivatives at both ends, and monotone in between."""
    p = sp.Poly(sp.expand(smooth_step(n)), t)
    assert p.degree() == 2 * n + 1
    assert (p.eval(0), p.eval(1)) == (0, 1)
    assert all(p.diff((t, k)).eval(end) == 0 for k in range(1, n + 1) for end in (0, 1))
    assert sp.factor(p.diff(t).as_expr()) == sp.factor((2 * n + 1) * comb(2 * n, n) * (t * (1 - t)) ** n)


@pytest.mark.parametrize("n", range(1, 8))
def test_step(n: int) -> None:
    """Against the exact polynomial, at fractions s = j/16 of the transition: powers of s round with eps each, and so does
    every product with a coefficient."""
    start, height, begin, duration = p = np.array([0.25, -1.5, 1.0, 4.0])
    polynomial = sp.Poly(sp.expand(smooth_step(n)), t)
    for j in range(17):
        got = REFERENCES["step"].evaluate(begin + duration * j / 16, p, n)
        for k in range(n + 1):
            d = polynomial.diff((t, k)) if k else polynomial
            exact = float(sp.Rational(height) * d.eval(sp.Rational(j, 16))) / duration**k + (start if k == 0 else 0)
            size = abs(height) * sum(abs(float(c)) * (j / 16) ** e[0] for e, c in d.terms()) / duration**k + abs(start)
            assert abs(got[k] - exact) <= EPS * (6 * n + 10) * size


def test_step_is_the_incomplete_beta_function(rng: np.random.Generator) -> None:
    """y_d = start + height I_s(n+1, n+1), s the elapsed fraction; rounding as above, the coefficients are below 2^(3n+3)."""
    times = rng.uniform(0, 6, 50)
    for n in range(1, 6):
        got = REFERENCES["step"].evaluate(times, np.array([0.5, 2.0, 1.0, 4.0]), n)[:, 0]
        expected = 0.5 + 2.0 * betainc(n + 1, n + 1, np.clip((times - 1.0) / 4.0, 0, 1))
        np.testing.assert_allclose(got, expected, rtol=0, atol=EPS * 2.0 ** (3 * n + 3) * 10)


@pytest.mark.parametrize("n", range(1, 8))
def test_step_rests_before_and_after(n: int) -> None:
    p = np.array([0.25, -1.5, 1.0, 4.0])
    rest = np.zeros(n)
    for time in (-1.0, 0.0, 1.0):
        np.testing.assert_array_equal(REFERENCES["step"].evaluate(time, p, n), [0.25, *rest])
    for time in (5.0, 9.0):
        np.testing.assert_array_equal(REFERENCES["step"].evaluate(time, p, n), [-1.25, *rest])


@pytest.mark.parametrize("name", REFERENCES)
def test_scaled(name: str) -> None:
    """In a plant's units: y_d^(k)(t) = offset (k = 0) + scale rate^k f^(k)(rate t), for the defaults and the drawn ones."""
    scale, offset, rate = 0.5, 0.25, 2.0  # powers of two: the parameters are scaled exactly
    family, own = REFERENCES[name], REFERENCES[name].scaled(scale, offset, rate)
    times = np.linspace(0, 10, 41)
    pairs = [({}, {})] + [
        ({k: v[i] for k, v in family.sets.items()}, {k: v[i] for k, v in own.sets.items()}) for i in (0, 1)
    ]
    for given, given_own in pairs:
        f = family.evaluate(rate * times, family.parameters(given), ORDER)
        got = own.evaluate(times, own.parameters(given_own), ORDER)
        factors = scale * rate ** np.arange(ORDER + 1)
        np.testing.assert_allclose(got, f * factors + offset * (np.arange(ORDER + 1) == 0), rtol=1e-12, atol=1e-12)


# -- contract over the registry ---------------------------------------------------------------------------------------


@FAMILIES
@pytest.mark.parametrize("order", [2, 4])
def test_each_derivative_is_that_of_the_one_before(family: Reference, order: int) -> None:
    """Central differences are of order 2: twice the spacing, four times the error, unless both are rounding errors."""
    p = family.parameters({})
    begin, end = (1.0, 5.0) if "duration" in family.defaults else (0.0, 10.0)
    times = np.linspace(begin, end, 41)[1:-1]
    h = 0.01 * 2.0 ** np.arange(2)
    exact = family.evaluate(times, p, order)[:, 1:]
    worst = []
    for spacing in h:
        after, before = (family.evaluate(times + s, p, order)[:, :-1] for s in (spacing, -spacing))
        worst.append(np.abs((after - before) / (2 * spacing) - exact).max(axis=0))
    rounding = 1e3 * EPS / h[0]  # coefficients of the step at order 4: up to 630
    for fine, coarse in zip(*worst, strict=True):
        assert fine <= rounding or np.log2(coarse / fine) == pytest.approx(2, abs=0.01)


@FAMILIES
def test_shapes(family: Reference) -> None:
    p = family.parameters({})
    assert p.shape == (len(family.defaults),)
    for shape in ((), (5,), (2, 3)):
        assert family.evaluate(np.ones(shape), p, 3).shape == (*shape, 4)
    grid = np.array([[0.0, 1.5], [2.5, 3.0]])
    np.testing.assert_array_equal(family.evaluate(grid, p, 3)[1, 0], family.evaluate(2.5, p, 3))


@FAMILIES
def test_the_lower_derivatives_do_not_depend_on_the_order(family: Reference) -> None:
    """But for the step, which is as smooth as it has to be."""
    if "duration" not in family.defaults:
        p = family.parameters({})
        np.testing.assert_array_equal(family.evaluate(2.0, p, 5)[:4], family.evaluate(2.0, p, 3))


@FAMILIES
def test_draw(family: Reference) -> None:
    """Inside the sets, all of each set; what is given or has no set stays; the same generator draws the same."""
    names = list(family.defaults)
    drawn = np.array([family.draw(rng, {}) for rng in map(np.random.default_rng, range(200))])
    for name, column in zip(names, drawn.T, strict=True):
        low, high = family.sets.get(name, (family.defaults[name],) * 2)
        assert low <= column.min() <= low + 0.1 * (high - low)  # missed by 200 draws with probability 0.9^200 = 7e-10
        assert high - 0.1 * (high - low) <= column.max() <= high
    np.testing.assert_array_equal(drawn[3], family.draw(np.random.default_rng(3), {}))
    given = family.draw(np.random.default_rng(3), {names[0]: 0.125})
    np.testing.assert_array_equal(given, [0.125, *drawn[3][1:]])


@FAMILIES
def test_extremes_enclose_what_is_drawn(family: Reference) -> None:
    corners = np.array(family.extremes({}))
    for seed in range(50):
        drawn = family.draw(np.random.default_rng(seed), {})
        assert (corners.min(axis=0) <= drawn).all()
        assert (drawn <= corners.max(axis=0)).all()
    name = next(iter(family.defaults))
    assert {row[0] for row in family.extremes({name: 0.125})} == {0.125}


@FAMILIES
def test_parameters(family: Reference) -> None:
    name, default = next(iter(family.defaults.items()))
    assert family.parameters({})[0] == default
    assert family.parameters({name: 3})[0] == 3.0
    for value in (np.nan, np.inf, "1", None, True, [1.0]):
        with pytest.raises(ValueError, match=f"`reference_parameters` must be finite numbers, got {name} = "):
            family.parameters({name: value})
    with pytest.raises(ValueError, match=r"`reference_parameters` must be among \['.*'\], got \['3', 'colour'\]"):
        family.parameters({"colour": 1.0, 3: 1.0})


@pytest.mark.parametrize("duration", [0.0, -1.0])
def test_a_step_takes_time(duration: float) -> None:
    with pytest.raises(ValueError, match=f"`duration` of the reference must be positive, got {duration}"):
        REFERENCES["step"].parameters({"duration": duration})


@pytest.mark.parametrize("name", ["square", None, ["sine"]])
def test_unknown_family(name: object) -> None:
    with pytest.raises(ValueError, match=r"`reference` must be one of \['chirp', 'constant', .*\], got "):
        references.get(name)
