"""Linear design of the two loops: gains from poles, the Lyapunov function V = e' P e, and the sliding surface w = 0.

[1] Tietze, Wulff, Reger: Trajectory tracking model-following control using Lyapunov redesign with output time-derivatives
    to compensate unmatched uncertainties.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray
from scipy.linalg import solve_continuous_lyapunov

from mfc_gym.checks import vector

Array = NDArray[np.float64]


def brunovsky(n: int) -> tuple[Array, Array]:
    """(A, B) of the chain of n integrators, shapes (n, n) and (n,)."""
    return np.eye(n, k=1), np.eye(n)[-1]


def place(poles: Sequence[complex], name: str = "poles") -> Array:
    """Gains k with eig(A - B k') = poles, shape (n,). Raises ValueError unless they are stable and closed under conjugation."""
    given = _array(poles, complex)
    if given.ndim != 1 or not given.size or not np.isfinite(given).all() or not (given.real < 0).all():
        raise ValueError(f"`{name}` must be a list of numbers with negative real part, got {poles!r}.")
    k = np.poly(given)[:0:-1]
    if np.abs(np.imag(k)).max() > 1e-9 * np.abs(k).max():
        raise ValueError(f"`{name}` must be closed under conjugation, got {poles!r}.")
    return np.real(k)


def _array(given: Any, kind: type) -> NDArray[Any]:
    """Numbers of this kind; a NaN for what are none."""
    try:
        return np.asarray(given, dtype=kind)
    except (TypeError, ValueError):
        return np.array(np.nan)


def hurwitz(name: str, k: Sequence[float], n: int) -> Array:
    """The gains k, shape (n,), checked: A - B k' must be Hurwitz. Raises ValueError naming `name` and the poles."""
    gains = vector(name, k, n)
    poles = np.roots([1.0, *gains[::-1]])
    if not (poles.real < 0).all():
        raise ValueError(f"`{name}` must make A - B k' Hurwitz, got {gains} with poles {np.round(poles, 4)}.")
    return gains


def closed_loop(k: Array) -> Array:
    """A - B k', shape (n, n)."""
    A, B = brunovsky(len(k))
    return A - np.outer(B, k)


def from_Q(k: Array, Q: Array | None = None) -> Array:
    """P of (A - B k')' P + P (A - B k') = -Q, shape (n, n); the paper's choice is Q = I."""
    Q = np.eye(len(k)) if Q is None else np.asarray(Q, dtype=float)
    return positive_definite(
        "Q", solve_continuous_lyapunov(closed_loop(k).T, -positive_definite("Q", Q, len(k))), len(k)
    )


def equal_poles(pole: float, n: int) -> Array:
    """P whose surface w = 0 has all n-1 poles at -pole, for gains with all n poles at -pole; shape (n, n).

    P = T' D T, rows of T the coefficients of (s + pole)^i, D = diag(pole^(2 (n-1-i))), i = 0 .. n-1. Then P B are the
    coefficients of (s + pole)^(n-1) and V' <= -2 pole (1 - cos(pi / (n+1))) V.
    """
    T = np.zeros((n, n))
    for i in range(n):
        T[i, : i + 1] = np.poly([-pole] * i)[::-1] if i else 1.0
    return T.T @ np.diag([pole ** (2.0 * (n - 1 - i)) for i in range(n)]) @ T


def from_surface(k: Array, c: Array | None = None) -> Array:
    """P with P B = c and (A - B k')' P + P (A - B k') < 0, for any Hurwitz k and any surface it admits; shape (n, n).

    By the positive real lemma P exists iff c(s) / a(s) is strictly positive real, a(s) = det(sI - A + B k'). With the decay
    eps: (A - B k' + eps I)' P + P (A - B k' + eps I) = -l l', where l(s - eps) is a spectral factor of
    c(s - eps) a(-s - eps) + c(-s - eps) a(s - eps). The stable and the antistable factor give the least and the greatest
    such P, both nearly singular; their mean is not. Without `c` the surface is a'(s) / n, which all gains
    admit, since a'(s) / a(s) = sum 1 / (s + p_i) has positive real part (n equal poles: `equal_poles`).
    Raises ValueError for a surface that the gains do not admit.
    """
    a = Polynomial([*k, 1.0])
    surface_polynomial = a.deriv() / len(k) if c is None else Polynomial(c)
    slowest = -np.max(a.roots().real)
    for eps in slowest * np.array([0.5, 0.2, 0.05, 0.01, 0.001]):
        shifted = [p(Polynomial([-eps, 1.0])) for p in (surface_polynomial, a)]
        mirrored = [p(Polynomial([-eps, -1.0])) for p in (surface_polynomial, a)]
        even = shifted[0] * mirrored[1] + mirrored[0] * shifted[1]
        # m(s) m(-s) = even(s): a polynomial in s^2, positive on the imaginary axis if strictly positive real
        squares = Polynomial(even.coef[::2]).roots()
        if even.coef[0] <= 0 or ((np.abs(squares.imag) < 1e-9 * np.abs(squares)) & (squares.real < 0)).any():
            continue
        roots, drift = -np.sqrt(squares.astype(complex)), (closed_loop(k) + eps * np.eye(len(k))).T
        P = np.zeros((len(k), len(k)))
        for factor in (np.poly(roots), np.poly(-roots)):
            m = Polynomial(np.real(factor)[::-1])
            coefficients = (m * np.sqrt(even.coef[0]) / m.coef[0])(Polynomial([eps, 1.0])).coef
            l_factor = np.pad(coefficients, (0, len(k) - len(coefficients)))
            P += solve_continuous_lyapunov(drift, -np.outer(l_factor, l_factor)) / 2
        P = (P + P.T) / 2
        if np.allclose(surface(P), surface_polynomial.coef, rtol=1e-6):
            return positive_definite("P", P, len(k))
    raise ValueError(
        f"`sliding_poles` must make c(s) / a(s) strictly positive real for the process poles {np.round(a.roots(), 4)}, "
        f"got {np.round(surface_polynomial.roots(), 4)}."
    )


def positive_definite(name: str, P: Array, n: int) -> Array:
    """P checked: symmetric, positive definite, shape (n, n). Raises ValueError naming `name`."""
    found = _array(P, float)
    square = found.shape == (n, n) and np.isfinite(found).all()
    if not square or not np.allclose(found, found.T, atol=1e-9 * np.abs(found).max()):
        raise ValueError(f"`{name}` must be a symmetric matrix of shape ({n}, {n}), got {P}.")
    if (smallest := np.linalg.eigvalsh(found)[0]) <= 0:
        raise ValueError(f"`{name}` must be positive definite, got smallest eigenvalue {smallest:g}.")
    return found


def dissipation(P: Array, k: Array) -> Array:
    """W's matrix -((A - B k')' P + P (A - B k')), which must be positive definite; shape (n, n)."""
    half = -closed_loop(k).T @ P
    return half + half.T


def surface(P: Array) -> Array:
    """c = P B, so that w = 2 c' e, eq. (22b) of [1]; shape (n,)."""
    return np.asarray(P)[:, -1]


def sliding_poles(P: Array) -> NDArray[np.complex128]:
    """Poles of the motion on w = 0: roots of c_n s^(n-1) + ... + c_1, shape (n-1,)."""
    return np.sort_complex(np.roots(surface(P)[::-1]).astype(complex))
