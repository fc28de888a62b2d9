"""Differentiators: sampled output y_k -> estimates of y, y', ..., y^(n-1) at the same sample.

Every differentiator is a kernel for one row, ``name(memory, measurement, bound, dt, settings, estimate) -> None``:

- ``memory``, shape (n,): the estimate at the last sample, [y, y', ..., y^(n-1)]; updated in place
- ``measurement``: the new sample y_k
- ``bound``: L > 0 with abs(y^(n)) <= L, may change from call to call; ignored unless `Differentiator.needs_bound`
- ``dt``: time since the last sample, s
- ``settings``: the values of `Differentiator.settings`, in that order
- ``estimate``, shape (n,): written with [y, y', ..., y^(n-1)] at the current sample; must not alias ``memory``

All but the filtered difference are observers in Taylor coordinates Y_i = dt^i y^(i), i = 0 ... m = n - 1,

    Y <- Phi Y,   b = y_k - Y_0,   Y <- Y + C g(b),   Phi_ij = 1 / (j - i)! for j >= i:

a prediction, exact for polynomials of degree m, then injections g_0 ... g_m. They use y_k, hence no latency.
Measurement, bound and initial guess are limited to `LARGE`, so that finite input never becomes NaN.

[1] Tietze, Wulff, Reger: Trajectory tracking model-following control using Lyapunov redesign with output
    time-derivatives to compensate unmatched uncertainties.
[2] Levant: Higher-order sliding modes, differentiation and output-feedback control. Int. J. Control 76, 2003; gains as
    in Levant, Livne, Eur. J. Control 2020, doi 10.1016/j.ejcon.2019.08.006.
[3] Levant: Non-homogeneous finite-time-convergent differentiator. CDC 2009.
[4] Livne, Levant: Proper discretization of homogeneous differentiators. Automatica 50, 2014.
[5] Seeber: implicit robust exact differentiator. arXiv 2404.02770, 2024.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import comb, factorial

import numpy as np
from numpy.typing import NDArray

from mfc_gym.compiled import njit

Array = NDArray[np.float64]
Kernel = Callable[[Array, float, float, float, Array, Array], None]

N_MAX = 13  # LAMBDA is published up to order m = 12
LARGE = 1e100  # its powers and products below stay far from overflow
NEWTON_STEPS = 20  # a guard: at most 7 were measured
NEWTON_TOLERANCE = 1e-8  # of the last step; quadratic convergence leaves the rounding error

# Gains of the recursive form: lambda_j [2], mu_j of the linear terms [3]. mu_6 ... mu_12 are ours, about 2.2 mu_(j-2)
# or more, so that the linear part alone stays Hurwitz for every order.
LAMBDA = np.array([1.1, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 12.0, 14.0, 17.0, 20.0, 26.0, 32.0])
MU = np.array([2.0, 3.0, 4.0, 7.0, 9.0, 13.0, 25.0, 32.0, 55.0, 70.0, 121.0, 154.0, 266.0])


def homogeneous_gains(m: int) -> Array:
    """lt_0 ... lt_m of the non-recursive form, shape (m+1,): lt_m = lambda_m, lt_j = lambda_j lt_(j+1)^(j/(j+1))."""
    lt = LAMBDA[: m + 1].copy()
    for j in range(m - 1, -1, -1):
        lt[j] *= lt[j + 1] ** (j / (j + 1))
    return lt


def stirling_map(n: int) -> Array:
    """C_ij = i!/j! [j+1, i+1], j >= i, shape (n, n), with unsigned Stirling numbers of the first kind.

    From backward differences to derivatives: dt^i y^(i) = (-ln(1-nabla))^i y. The output map of [5] consists of the
    coefficients c_ij = i/j C_(i-1)(j-1) of x^j in (-ln(1-x))^i, and C_ij = c_ii + ... + c_ij.
    """
    C = np.zeros((n, n))
    C[0] = 1
    for i in range(1, n):
        for j in range(i, n):
            C[i, j] = C[i, j - 1] + i / j * C[i - 1, j - 1]
    return C


def taylor_map(n: int, step: float) -> Array:
    """Phi(step)_ij = step^(j-i) / (j-i)!, j >= i, shape (n, n)."""
    return np.array([[step ** (j - i) / factorial(j - i) if j >= i else 0.0 for j in range(n)] for i in range(n)])


GAINS = np.array([np.pad(homogeneous_gains(m), (0, N_MAX - 1 - m)) for m in range(N_MAX)])  # [m, j] = lt_j for order m
BINOMIAL = np.array([[float(comb(n, j)) for j in range(N_MAX + 1)] for n in range(N_MAX + 1)])
STIRLING = stirling_map(N_MAX)
BACKSHIFT = taylor_map(N_MAX, -1.0)


@njit
def limited(x: float) -> float:
    return min(max(x, -LARGE), LARGE)


@njit
def largest_difference(bound: float, dt: float, n: int) -> float:
    """A = L dt^n, the bound of the n-th difference of y."""
    return min(max(bound, 1 / LARGE), LARGE) * dt**n


@njit
def predict(memory: Array, measurement: float, dt: float) -> float:
    """memory <- Taylor polynomial one sample later, by Horner; returns the innovation b."""
    n = memory.size
    for i in range(n):
        y = memory[n - 1]
        for j in range(n - 1 - i, 0, -1):
            y = memory[i + j - 1] + dt / j * y
        memory[i] = y
    return limited(measurement) - memory[0]


@njit
def correct(memory: Array, C: Array, dt: float, estimate: Array) -> None:
    """memory_i <- memory_i + dt^-i sum_j C_ij g_j; `estimate` brings the injections g, leaves with the new memory."""
    scale = 1.0
    for i in range(memory.size):
        s = 0.0
        for j in range(i, memory.size):
            s += C[i, j] * estimate[j]
        memory[i] += s / scale
        estimate[i] = memory[i]
        scale *= dt


@njit
def homogeneous_root(R: float, a: float, n: int) -> float:
    """p > 0 with F(p) = p^n + sum_(j=1..m) lt_j a^(n-j) p^j = R > 0.

    F is a posynomial: convex in log-log scale, of slope 1 ... n. There Newton falls monotonically onto the root.
    """
    m = n - 1
    p = R ** (1 / n)
    for _ in range(NEWTON_STEPS):
        F, dF = 1.0, 0.0
        for j in range(m, 0, -1):
            dF = F + p * dF
            F = GAINS[m, j] * a ** (n - j) + p * F
        dF = F + p * dF
        last, p = p, p * (R / (p * F)) ** (F / dF)
        if p > last * (1 - NEWTON_TOLERANCE):
            break
    return p


@njit
def ired(memory: Array, measurement: float, bound: float, dt: float, settings: Array, estimate: Array) -> None:
    """Implicit robust exact differentiator of order m = n - 1 [5]; no settings.

    Backward Euler of z_i' = z_(i+1) - lt_(m-i) L^((i+1)/n) |z_0-y|^((m-i)/n) sgn(z_0-y), in the Taylor coordinates of
    its output map: g_j = lt_(m-j) a^(j+1) p^(m-j) sgn b, a = L^(1/n) dt, and p^n = |b - g_0 - ... - g_m|, what is left
    of b. In the sliding mode, |b| <= lt_0 a^n, only g_m = b: nothing is left (y_0 = y_k), all poles are at 0, and the
    noise-free errors are c_in dt^(n-i) sup|y^(n)| to leading order, c of `stirling_map` (n = 3: dt^2/3 and dt).
    Rounding acts like noise of size eps |y|: it ends the sliding mode once 2^n eps |y| exceeds (lt_0 - 1) L dt^n.
    """
    n = memory.size
    m = n - 1
    b = predict(memory, measurement, dt)
    A = largest_difference(bound, dt, n)
    g = GAINS[m, 0] * A
    if abs(b) <= g:
        estimate[:] = 0.0
        estimate[m] = b
    else:
        a = A ** (1 / n)
        p = homogeneous_root(abs(b) - g, a, n)
        for j in range(n):
            estimate[j] = np.sign(b) * GAINS[m, m - j] * a ** (j + 1) * p ** (m - j)
    correct(memory, STIRLING, dt, estimate)


@njit
def hdd(memory: Array, measurement: float, bound: float, dt: float, settings: Array, estimate: Array) -> None:
    """Homogeneous discrete-time differentiator of order m = n - 1 [4]; no settings; noise-free errors O(dt^(n-i)).

    z <- Phi z - dt (the injections of `ired`, explicit, at z_0 - y_k), z the prediction for t_k made from y_(k-1). The
    estimate is the new z, which contains y_k, shifted back from t_(k+1) to t_k by the inverse of Phi: latency 0.
    """
    n = memory.size
    m = n - 1
    b = predict(memory, measurement, dt)
    a = largest_difference(bound, dt, n) ** (1 / n)
    p = abs(b) ** (1 / n)
    for j in range(n):
        estimate[j] = np.sign(b) * GAINS[m, m - j] * a ** (j + 1) * p ** (m - j)
    correct(memory, BACKSHIFT, dt, estimate)


@njit
def mixed_root(R: float, A: float, kappa: float, n: int) -> float:
    """p > 0 with F(p) = p^n + g_0 + ... + g_m - lambda_0 A = R > 0, g of `ired_linear`.

    With g_j = p^(m-j) r, each r is a sum of products of powers of the one before: Newton as in `homogeneous_root`.
    """
    p = R ** (1 / n)
    for _ in range(NEWTON_STEPS):
        F, dF, r, dr = p**n, n * p ** (n - 1), 1.0, 0.0
        for k in range(n, 1, -1):
            h, c = LAMBDA[k - 1] * A ** (1 / k) * r ** (1 - 1 / k), kappa * MU[k - 1]
            dr = ((1 - 1 / k) * h / r + c * p) * dr + c * r
            r = h + c * p * r
            F += p ** (k - 1) * r
            dF += (k - 1) * p ** (k - 2) * r + p ** (k - 1) * dr
        F += kappa * MU[0] * p * r
        dF += kappa * MU[0] * (r + p * dr)
        last, p = p, p * (R / F) ** (F / (p * dF))
        if p > last * (1 - NEWTON_TOLERANCE):
            break
    return p


@njit
def ired_linear(memory: Array, measurement: float, bound: float, dt: float, settings: Array, estimate: Array) -> None:
    """Levant's non-homogeneous differentiator [3], discretised like `ired`; settings = [rate of the linear terms, 1/s].

    z_i' = z_(i+1) - s_(i+1), s_(i+1) = lambda_(k-1) L^(1/k) |s_i|^(1-1/k) sgn s_i + rate mu_(k-1) s_i, k = n - i, from
    s_0 = z_0 - y. Far from the signal the linear terms rule and errors fall exponentially; in the sliding mode s_0 = 0,
    they vanish, and the estimate is that of `ired`. Backward Euler keeps the linear part stable for every dt; explicit
    terms as in `hdd` would need rate dt < 1.0, 0.50, 0.16, 0.051, 0.080, 0.028, 0.051, 0.027 for n = 1 ... 8.
    """
    n = memory.size
    b = predict(memory, measurement, dt)
    A = largest_difference(bound, dt, n)
    g = LAMBDA[0] * A
    if abs(b) <= g:
        estimate[:] = 0.0
        estimate[n - 1] = b
    else:
        kappa = settings[0] * dt
        p = mixed_root(abs(b) - g, A, kappa, n)
        r = 1.0
        for k in range(n, 1, -1):
            r = LAMBDA[k - 1] * A ** (1 / k) * r ** (1 - 1 / k) + kappa * MU[k - 1] * p * r
            estimate[n - k] = np.sign(b) * p ** (k - 1) * r
        estimate[n - 1] = np.sign(b) * (g + kappa * MU[0] * p * r)
    correct(memory, STIRLING, dt, estimate)


@njit
def high_gain(memory: Array, measurement: float, bound: float, dt: float, settings: Array, estimate: Array) -> None:
    """High-gain observer with binomial gains, settings = [bandwidth omega_o = 1/epsilon, rad/s].

    All n discrete poles at zeta = exp(-omega_o dt) by g_j = binom(n, j+1) (1-zeta)^(j+1) zeta^(m-j) b, since the
    innovation obeys (1-x)^n y = (1-zeta x)^n b, x the delay, and 1 - zeta x = zeta (1-x) + (1-zeta). Once settled it is
    exact for polynomials of degree m. As dt -> 0: y_i' = y_(i+1) + binom(n, i+1) omega_o^(i+1) (y - y_0).
    """
    n = memory.size
    b = predict(memory, measurement, dt)
    zeta = np.exp(-settings[0] * dt)
    eta = -np.expm1(-settings[0] * dt)
    for j in range(n):
        estimate[j] = BINOMIAL[n, j + 1] * eta ** (j + 1) * zeta ** (n - 1 - j) * b
    correct(memory, STIRLING, dt, estimate)


@njit
def dirty_derivative(
    memory: Array, measurement: float, bound: float, dt: float, settings: Array, estimate: Array
) -> None:
    """Cascade of filtered differences s/(tau s + 1) by backward Euler, settings = [tau, s]; y_0 = y_k.

    d_k = (tau d_(k-1) + u_k - u_(k-1)) / (tau + dt), u the output of the stage before: pole tau/(tau+dt) in [0, 1) for
    every dt, and y^(i) lags by i (tau + dt/2).
    """
    tau = settings[0]
    u, u_last = limited(measurement), memory[0]
    memory[0] = estimate[0] = u
    for i in range(1, memory.size):
        d_last = memory[i]
        u = (tau * d_last + u - u_last) / (tau + dt)
        u_last = d_last
        memory[i] = estimate[i] = u


@njit
def memory_is_estimate(memory: Array, estimate: Array) -> None:
    """Start from a guess [y, y', ..., y^(n-1)] at the sample before the first measurement."""
    for i in range(memory.size):
        memory[i] = limited(estimate[i])


def one_per_derivative(n: int) -> int:
    """n numbers of memory for n estimates."""
    if not 1 <= n <= N_MAX:
        raise ValueError(f"`n` must lie in 1 ... {N_MAX}, got {n}.")
    return n


@dataclass(frozen=True)
class Differentiator:
    update: Kernel
    needs_bound: bool  # whether `bound` is used
    settings: Mapping[str, float] = field(default_factory=dict)
    memory_size: Callable[[int], int] = one_per_derivative
    initial: Callable[[Array, Array], None] = memory_is_estimate  # (memory, estimate): memory <- guess


DIFFERENTIATORS: Mapping[str, Differentiator] = {
    "ired": Differentiator(ired, needs_bound=True),
    "hdd": Differentiator(hdd, needs_bound=True),
    # 1/s: MU was tuned for errors that fall within seconds
    "ired-linear": Differentiator(ired_linear, needs_bound=True, settings={"rate": 1.0}),
    # rad/s: ten times the error dynamics of the example of [1], poles at -4
    "high-gain": Differentiator(high_gain, needs_bound=False, settings={"bandwidth": 40.0}),
    # s: the same corner frequency as the high-gain observer
    "dirty": Differentiator(dirty_derivative, needs_bound=False, settings={"time_constant": 0.025}),
}


@njit
def bound_from_input(alpha: float, beta_u: float, delta_1: float, delta_3: float, floor: float) -> float:
    """L >= abs(y^(n)) = abs(alpha + Delta_1 + (1 + Delta_3) beta u) over the coming sample, from its start.

    alpha = L_f^n h, beta u = L_g L_f^(n-1) h u, abs(Delta_i) <= delta_i; 20 % for the change within one sample.
    """
    return max(floor, 1.2 * (abs(alpha) + delta_1 + (1 + delta_3) * abs(beta_u)))


@njit
def run_time_bound(
    alpha: float, delta_1: float, delta_3: float, omega_star: float, v_tilde: float, Gamma: float, floor: float
) -> float:
    """`bound_from_input` for the law of [1], beta u = -alpha + omega* + v~ + v_L with abs(v_L) <= Gamma."""
    return bound_from_input(alpha, abs(-alpha + omega_star + v_tilde) + Gamma, delta_1, delta_3, floor)
