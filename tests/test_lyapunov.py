"""Gains, Lyapunov matrices and sliding surfaces against closed forms and theorems of linear system theory."""

from fractions import Fraction
from math import comb, cos, pi, sin
from typing import Any

import numpy as np
import pytest
from scipy.linalg import companion

from baselines import lyapunov
from baselines.lyapunov import Array

EPS = float(np.finfo(float).eps)
ORDERS = range(2, 9)

# numerics of the example in Section 6 of [1]: P of k_tilde = [64, 48, 12] and Q = I, in exact fractions
P_EXAMPLE = np.array(
    [
        [337 / 64, 811 / 256, 1 / 128],
        [811 / 256, 823 / 256, 313 / 4096],
        [1 / 128, 313 / 4096, 787 / 16384],
    ]
)


def binomial(pole: float, n: int) -> Array:
    """Coefficients of (s + pole)^n without the leading one, lowest first."""
    return np.array([comb(n, i) * pole ** (n - i) for i in range(n)])


def lyapunov_error(A: Array, P: Array) -> float:
    """Bound of the error of P in A' P + P A = -I.

    A backward stable solver leaves a residual R of about n^2 eps 2 norm(A) norm(P) at most (Bartels and Stewart). It
    moves P by the integral of exp(A't) R exp(At), at most norm(R) times that of exp(A't) exp(At), which is P itself.
    """
    return float(2 * len(A) ** 2 * EPS * np.linalg.norm(A) * np.linalg.norm(P) ** 2)


def test_brunovsky() -> None:
    A, B = lyapunov.brunovsky(3)
    np.testing.assert_array_equal(A, [[0, 1, 0], [0, 0, 1], [0, 0, 0]])
    np.testing.assert_array_equal(B, [0, 0, 1])


@pytest.mark.parametrize("n", ORDERS)
@pytest.mark.parametrize("pole", [0.5, 1.0, 4.0])
def test_equal_poles_have_binomial_gains(pole: float, n: int) -> None:
    """Products of powers of two and integers below 2^53: exact."""
    np.testing.assert_array_equal(lyapunov.place([-pole] * n), binomial(pole, n))


def test_gains_of_the_example() -> None:
    np.testing.assert_array_equal(lyapunov.place([-1, -1, -1]), [1, 3, 3])
    np.testing.assert_array_equal(lyapunov.place([-4, -4, -4]), [64, 48, 12])


def test_complex_poles() -> None:
    """(s^2 + 2 s + 5) (s + 3) = s^3 + 5 s^2 + 11 s + 15, in integers."""
    np.testing.assert_array_equal(lyapunov.place([-1 + 2j, -3, -1 - 2j]), [15, 11, 5])


@pytest.mark.parametrize("n", ORDERS)
def test_closed_loop_is_the_companion_matrix_of_the_poles(n: int) -> None:
    """A - B k' is the companion matrix of the polynomial with the coefficients k, rows and columns turned."""
    k = lyapunov.place(-np.arange(1.0, n + 1))
    np.testing.assert_array_equal(lyapunov.closed_loop(k), companion([1.0, *k[::-1]])[::-1, ::-1])


def test_hurwitz_is_the_criterion_of_routh() -> None:
    """s^3 + k3 s^2 + k2 s + k1 is stable if and only if all k > 0 and k2 k3 > k1."""
    rng = np.random.default_rng(1)
    accepted = 0
    for k in rng.uniform(-1, 5, (300, 3)):
        k1, k2, k3 = k
        if min(abs(k1), abs(k2 * k3 - k1)) < 1e-3:
            continue  # within the error of the numeric roots of the border
        stable = min(k) > 0 and k2 * k3 > k1
        accepted += stable
        if stable:
            np.testing.assert_array_equal(lyapunov.hurwitz("k", k, 3), k)
        else:
            with pytest.raises(ValueError, match=r"`k` must make A - B k' Hurwitz, got .* with poles"):
                lyapunov.hurwitz("k", k, 3)
    assert accepted > 50


def test_lyapunov_matrix_of_the_example() -> None:
    k = np.array([64.0, 48.0, 12.0])
    bound = lyapunov_error(lyapunov.closed_loop(k), P_EXAMPLE)
    assert bound < 2e-11
    np.testing.assert_allclose(lyapunov.from_Q(k), P_EXAMPLE, rtol=0, atol=bound)


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_solution_of_the_lyapunov_equation(n: int) -> None:
    """dissipation(from_Q(k, Q), k) = Q; the residual is that of the solver, see `lyapunov_error`."""
    rng = np.random.default_rng(n)
    for _ in range(10):
        k = lyapunov.place(-rng.uniform(0.5, 4, n))
        root = rng.normal(size=(n, n))
        Q = root @ root.T + 0.1 * np.eye(n)
        P = lyapunov.from_Q(k, Q)
        atol = 2 * n**2 * EPS * np.linalg.norm(lyapunov.closed_loop(k)) * np.linalg.norm(P)
        np.testing.assert_allclose(lyapunov.dissipation(P, k), Q, rtol=0, atol=atol)
        assert np.linalg.eigvalsh(P)[0] > 0


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_every_lyapunov_surface_is_stable(n: int) -> None:
    """B'P (sI - A + Bk')^-1 B is strictly positive real (Kalman, Yakubovich, Popov): its zeros are stable."""
    rng = np.random.default_rng(n)
    for _ in range(20):
        root = rng.normal(size=(n, n))
        P = lyapunov.from_Q(lyapunov.place(-rng.uniform(0.5, 4, n)), root @ root.T + 0.1 * np.eye(n))
        assert lyapunov.sliding_poles(P).real.max() < 0


def test_sliding_poles_of_the_example() -> None:
    """Published to five digits; and the roots of c_3 s^2 + c_2 s + c_1 by the formula, whose condition is below 10."""
    poles = lyapunov.sliding_poles(P_EXAMPLE)
    assert (np.abs(poles - [-1.4810, -0.10982]) <= [0.5e-4, 0.5e-5]).all()
    c1, c2, c3 = P_EXAMPLE[:, -1]
    root = np.sqrt(c2**2 - 4 * c1 * c3)
    np.testing.assert_allclose(poles, [(-c2 - root) / (2 * c3), (-c2 + root) / (2 * c3)], rtol=100 * EPS)


def pivots(M: Array) -> list[Fraction]:
    """Pivots of Gaussian elimination in exact fractions: all positive if and only if M > 0."""
    rows = [[Fraction(float(entry)) for entry in row] for row in M]
    for i, pivot in enumerate(rows):
        for row in rows[i + 1 :]:
            factor = row[i] / pivot[i]
            for j in range(i, len(rows)):
                row[j] -= factor * pivot[j]
    return [row[i] for i, row in enumerate(rows)]


@pytest.mark.parametrize("n", ORDERS)
def test_equal_sliding_poles_are_a_lyapunov_design(n: int) -> None:
    """P B = coefficients of (s + 1)^(n-1), P > 0 and Q > 0, all in integers and so without any rounding."""
    P, k = lyapunov.equal_poles(1.0, n), binomial(1.0, n)
    Q = lyapunov.dissipation(P, k)
    np.testing.assert_array_equal(lyapunov.surface(P), [*binomial(1.0, n - 1), 1])
    np.testing.assert_array_equal(P, P.T)
    assert min(pivots(P)) > 0
    assert min(pivots(Q)) > 0


@pytest.mark.parametrize("n", ORDERS)
@pytest.mark.parametrize("pole", [0.5, 4.0])
def test_scaling_of_the_pole_is_a_congruence(pole: float, n: int) -> None:
    """P(pole) = S P(1) S and Q(pole) = pole S Q(1) S with S = diag(pole^(n-1), ..., 1): definite for every pole.

    Exact for P: powers of two. Q is made of differences of products that are exact up to n = 6 (below 2^53 units).
    """
    S = np.diag(pole ** np.arange(n - 1, -1, -1))
    P = lyapunov.equal_poles(pole, n)
    np.testing.assert_array_equal(P, S @ lyapunov.equal_poles(1.0, n) @ S)
    np.testing.assert_array_equal(lyapunov.surface(P), [*binomial(pole, n - 1), 1])
    if n <= 6:
        scaled = pole * S @ lyapunov.dissipation(lyapunov.equal_poles(1.0, n), binomial(1.0, n)) @ S
        np.testing.assert_array_equal(lyapunov.dissipation(P, binomial(pole, n)), scaled)


def test_equal_poles_of_the_example() -> None:
    np.testing.assert_array_equal(lyapunov.equal_poles(4.0, 3), [[768, 192, 16], [192, 80, 8], [16, 8, 1]])


@pytest.mark.parametrize("n", ORDERS)
@pytest.mark.parametrize("pole", [1.0, 4.0])
def test_decay_rate_of_equal_poles(pole: float, n: int) -> None:
    """V' <= -2 pole (1 - cos(pi / (n+1))) V.

    With y_i = pole^(n-1-i) (d/dt + pole)^i e: V = abs(y)^2 and y_i' = pole (y_(i+1) - y_i). The symmetric part is a
    tridiagonal Toeplitz matrix, whose eigenvector y_i = sin((i+1) pi / (n+1)) attains the bound. Rounding: sums of n^2
    terms with a few errors each.
    """
    k, P = binomial(pole, n), lyapunov.equal_poles(pole, n)
    Q, rate = lyapunov.dissipation(P, k), 2 * pole * (1 - cos(pi / (n + 1)))
    T = np.array([[comb(i, j) * pole ** (i - j) if j <= i else 0.0 for j in range(n)] for i in range(n)])
    T = np.diag(pole ** np.arange(n - 1, -1, -1)) @ T
    rng = np.random.default_rng(n)
    attained = np.linalg.solve(T, [sin((i + 1) * pi / (n + 1)) for i in range(n)])
    e = np.vstack([attained, rng.normal(size=(1000, n)), np.linalg.solve(T, rng.normal(size=(n, 1000))).T])
    V = np.einsum("...i,ij,...j", e, P, e)
    W = np.einsum("...i,ij,...j", e, Q, e)
    rounding = 4 * n**2 * EPS * np.einsum("...i,ij,...j", abs(e), abs(Q) + rate * abs(P), abs(e))
    assert (rate * V <= W + rounding).all()
    assert abs(W[0] - rate * V[0]) <= rounding[0]


def test_sliding_poles_of_equal_poles() -> None:
    """A double root moves by the square root of the rounding error of its coefficients."""
    poles = lyapunov.sliding_poles(lyapunov.equal_poles(4.0, 3))
    np.testing.assert_allclose(poles, [-4, -4], rtol=0, atol=4 * np.sqrt(10 * EPS))


# -- surfaces of other gains, by the positive real lemma ------------------------------------------------------------------


def assert_lyapunov(P: Array, k: Array, c: Array) -> None:
    """P > 0, Q > 0 and P B = c, the last up to the solver's error, n^2 eps cond(P) with room for the spectral factor's."""
    assert np.linalg.eigvalsh(P)[0] > 0
    assert np.linalg.eigvalsh(lyapunov.dissipation(P, k))[0] > 0
    np.testing.assert_allclose(lyapunov.surface(P), c, rtol=len(k) ** 2 * EPS * np.linalg.cond(P))


def random_poles(rng: np.random.Generator, n: int) -> Array:
    """Real, in part complex or repeated."""
    poles = -rng.uniform(0.5, 5, n).astype(complex)
    kind = rng.integers(3)
    if kind == 1:
        poles[:2] = poles[0].real + 1j * rng.uniform(0.2, 3) * np.array([1, -1])
    elif kind == 2:
        poles[0] = poles[1]
    return poles


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_surface_beside_the_process_poles(n: int) -> None:
    """c(s) = a'(s) / n: a'(s) / a(s) = sum 1 / (s + p_i) is strictly positive real, whatever the poles."""
    rng = np.random.default_rng(n)
    for _ in range(30):
        k = lyapunov.place(random_poles(rng, n))
        derivative = np.append(k[1:] * np.arange(1, n) / n, 1.0)
        assert_lyapunov(lyapunov.from_surface(k), k, derivative)


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_interlacing_surface(n: int) -> None:
    """Zeros between real poles: all residues of c / a are positive, and so is its real part."""
    rng = np.random.default_rng(n)
    for _ in range(30):
        roots = -np.cumsum(rng.uniform(0.2, 1.5, 2 * n - 1))
        k, c = lyapunov.place(roots[::2]), np.append(lyapunov.place(roots[1::2]), 1.0)
        assert_lyapunov(lyapunov.from_surface(k, c), k, c)


def test_surfaces_of_the_second_order() -> None:
    """Re (jw + b) / (a0 - w^2 + j a1 w) > 0 for all w if and only if b a0 + (a1 - b) w^2 > 0: 0 < b < a1."""
    rng = np.random.default_rng(0)
    admitted = 0
    for _ in range(200):
        k = lyapunov.place(random_poles(rng, 2))
        b = rng.uniform(0.05, 1.5) * k[1]
        if abs(b / k[1] - 1) < 0.01:
            continue  # so close to the border that no decay rate is left to design for
        c = np.array([b, 1.0])
        if b < k[1]:
            admitted += 1
            assert_lyapunov(lyapunov.from_surface(k, c), k, c)
        else:
            with pytest.raises(ValueError, match=r"`sliding_poles` must make c\(s\) / a\(s\) strictly positive real"):
                lyapunov.from_surface(k, c)
    assert 50 < admitted < 150


@pytest.mark.parametrize("n", [3, 4, 5])
def test_surfaces_of_higher_order(n: int) -> None:
    """A surface is admitted if and only if Re c(jw) / a(jw) > 0 for all w, here on a grid; doubtful cases are left out."""
    rng = np.random.default_rng(n)
    w = np.append(0, np.logspace(-3, 4, 2000))
    admitted = refused = 0
    for _ in range(60):
        k, c = lyapunov.place(random_poles(rng, n)), np.append(lyapunov.place(random_poles(rng, n - 1)), 1.0)
        ratio = np.polyval(c[::-1], 1j * w) / np.polyval([1.0, *k[::-1]], 1j * w)
        real = ratio.real * (1 + w**2)
        if abs(real.min()) < 0.01 * real.max():
            continue
        if real.min() > 0:
            admitted += 1
            assert_lyapunov(lyapunov.from_surface(k, c), k, c)
        else:
            refused += 1
            with pytest.raises(ValueError, match="`sliding_poles` must make"):
                lyapunov.from_surface(k, c)
    assert admitted > 5
    assert refused > 5


def test_dissipation_of_a_large_design_stays_symmetric() -> None:
    """Q is symmetric to the last bit, however large the entries of P are; P of Q = I has cond 1e12 here."""
    k = lyapunov.place([-10.0] * 6)
    Q = lyapunov.dissipation(lyapunov.from_Q(k), k)
    np.testing.assert_array_equal(Q, Q.T)


@pytest.mark.parametrize("poles", [[], [0.0, -1.0], [-1.0, 1.0], [-1.0, np.nan], -1.0, [[-1.0]]])
def test_poles_that_are_no_stable_numbers(poles: Any) -> None:
    with pytest.raises(ValueError, match="`poles` must be a list of numbers with negative real part, got"):
        lyapunov.place(poles)


def test_poles_without_their_conjugates() -> None:
    with pytest.raises(ValueError, match="`poles` must be closed under conjugation, got"):
        lyapunov.place([-1 + 1j, -1 + 1j])


@pytest.mark.parametrize("k", [[1.0, 3.0], [1.0, np.nan, 3.0], [[1.0, 3.0, 3.0]], 3.0, None])
def test_gains_of_the_wrong_kind(k: Any) -> None:
    with pytest.raises(ValueError, match="`k` must be 3 finite numbers, got"):
        lyapunov.hurwitz("k", k, 3)


@pytest.mark.parametrize("k", [[0.0, 3.0, 3.0], [1.0, 1.0, 1.0], [-1.0, 3.0, 3.0]])
def test_gains_that_do_not_stabilise(k: list[float]) -> None:
    """A pole at 0, a pair on the imaginary axis (s^2 + 1) (s + 1) up to rounding, and a positive pole."""
    if k == [1.0, 1.0, 1.0]:
        k = [1.0, 1.0 - 1e-6, 1.0]  # just beyond the border, where the numeric roots decide
    with pytest.raises(ValueError, match="`k` must make A - B k' Hurwitz"):
        lyapunov.hurwitz("k", k, 3)


@pytest.mark.parametrize(
    ("P", "text"),
    [
        (np.eye(2), r"`P` must be a symmetric matrix of shape \(3, 3\)"),
        (np.eye(3, k=1), r"`P` must be a symmetric matrix of shape \(3, 3\)"),
        (np.full((3, 3), np.nan), r"`P` must be a symmetric matrix of shape \(3, 3\)"),
        (np.diag([1.0, 2.0, -3.0]), "`P` must be positive definite, got smallest eigenvalue -3"),
        (np.zeros((3, 3)), "`P` must be positive definite, got smallest eigenvalue 0"),
    ],
)
def test_matrices_that_are_not_positive_definite(P: Array, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        lyapunov.positive_definite("P", P, 3)


def test_Q_must_be_positive_definite() -> None:
    with pytest.raises(ValueError, match="`Q` must be positive definite"):
        lyapunov.from_Q(np.array([1.0, 3.0, 3.0]), -np.eye(3))
