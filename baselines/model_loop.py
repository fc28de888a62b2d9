"""The model control loop in sampled time.

e_star = xi* - xi_d. With the linear law v = -k' e_star, eq. (20) of [1], the loop obeys e_star' = (A - B k') e_star, eq. (21):
its exact sampled solution is e_star(t + dt) = E e_star(t), E = expm((A - B k') dt).
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit
def apply(M: Array, v: Array, out: Array) -> None:
    """out = M v, in a fixed order of summation."""
    for i in range(out.size):
        total = 0.0
        for j in range(v.size):
            total += M[i, j] * v[j]
        out[i] = total


@njit
def inner(a: Array, b: Array) -> float:
    """a' b, in a fixed order of summation."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


def hermite_matrix(n: int) -> Array:
    """From the mismatch of the derivatives at s = 1 to the coefficients of s^(n+1+m), s in [0, 1], shape (n+1, n+1).

    Inverse of M[i, m] = (n+1+m)! / (n+1+m-i)! for the three highest derivatives i = n-2 ... n and m = 0, 1, 2, which give
    y_d^(n) an error O(dt^4), that of the integration; the others are zero. Each further derivative would multiply the
    rounding error by 1 / dt: with all of them y_d^(5) is off by 100 at dt = 2 ms.
    """
    M = [[math.perm(n + 1 + m, i) for m in range(3)] for i in range(n - 2, n + 1)]
    out = np.zeros((n + 1, n + 1))
    out[:3, n - 2 :] = np.linalg.inv(np.array(M, dtype=float))
    return out


@njit
def interpolate(before: Array, coefficients: Array, s: float, dt: float, out: Array) -> None:
    """Reference and its n derivatives at the fraction s of the interval, from both ends' derivatives; out (n+1,).

    The polynomial of degree n + 3 that has all given derivatives at the left end and the three highest at the right end
    (Hermite): the Taylor polynomial at the left end plus sum_m coefficients[m] s^(n+1+m).
    """
    n = out.size - 1
    for i in range(n + 1):
        total, factor = 0.0, 1.0
        for j in range(i, n + 1):
            total += before[j] * factor
            factor *= s * dt / (j - i + 1)
        for m in range(n + 1):
            degree = n + 1 + m
            term = coefficients[m]
            for r in range(i):
                term *= (degree - r) / dt
            total += term * s ** (degree - i)
        out[i] = total


@njit
def hermite_coefficients(before: Array, after: Array, hermite: Array, dt: float, out: Array) -> None:
    """Coefficients of `interpolate` for derivatives `before` at s = 0 and `after` at s = 1; out (n+1,)."""
    n = before.size - 1
    mismatch = np.empty(n + 1)
    for i in range(n + 1):
        taylor, factor = 0.0, 1.0
        for j in range(i, n + 1):
            taylor += before[j] * factor
            factor *= dt / (j - i + 1)
        mismatch[i] = (after[i] - taylor) * dt**i
    apply(hermite, mismatch, out)
