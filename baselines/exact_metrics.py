"""Integrals and variation of the exact solution: what a sampled loop is compared with. u is the equivalent control in sliding."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from baselines.filippov import ExactSolution

Array = NDArray[np.float64]
CELL = 0.001  # s; the kinks of Gamma, which lie inside cells, cost O(CELL^2)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(4)


def zeros(exact: ExactSolution, signal: str, begin: float, end: float) -> list[float]:
    """Times in (begin, end) at which the signal changes sign continuously, s."""
    times = cells(exact, begin, end)
    ends = np.nextafter(times[1:], times[:-1])  # a sign change across a jump, at a switching time, is no zero
    left, right = exact.signals(times[:-1])[signal], exact.signals(ends)[signal]

    def at(t: float) -> float:
        return float(exact.signals(t)[signal])

    changes = np.flatnonzero(left * right < 0)
    return [float(brentq(at, times[i], ends[i], xtol=1e-14)) for i in changes]


def cells(exact: ExactSolution, begin: float, end: float) -> Array:
    """A grid over [begin, end] no wider than CELL that holds every switching time."""
    inner = exact.switching_times[(exact.switching_times > begin) & (exact.switching_times < end)]
    return np.unique(np.concatenate([np.linspace(begin, end, int(np.ceil((end - begin) / CELL)) + 1), inner]))


def integral(exact: ExactSolution, integrand: Callable[[Array, dict[str, Array]], Array], grid: Array) -> float:
    """Composite Gauss-Legendre quadrature of integrand(t, signals(t)) over the cells of the grid, order 8 where it is smooth."""
    a, b = grid[:-1, None], grid[1:, None]
    times = (a + b) / 2 + (b - a) / 2 * NODES
    values = integrand(times, exact.signals(times))
    return float(((b - a) / 2 * WEIGHTS * values).sum())


def total_variation(exact: ExactSolution, begin: float = 0.0, end: float | None = None) -> float:
    """Variation of the Filippov control over [begin, end], jumps included, unit of u."""
    end = exact.end if end is None else end
    grid = cells(exact, begin, end)
    fine = (grid[:-1, None] + np.diff(grid)[:, None] * np.linspace(0, 1, 3)[:-1]).ravel()
    fine = np.append(fine, end)
    before = np.nextafter(exact.switching_times, 0.0)
    times = np.sort(np.concatenate([fine, before[(before > begin) & (before < end)]]))
    return float(np.abs(np.diff(exact.signals(times)["u"])).sum())


def exact_metrics(exact: ExactSolution) -> dict[str, float]:
    """The metrics of `baselines.metrics` in continuous time, over the whole horizon. Raises ValueError if it ended early."""
    if exact.terminated:
        raise ValueError(f"`exact` must reach the horizon, it left the operating region at {exact.end} s.")
    T = exact.end
    e_cells = np.unique(np.concatenate([cells(exact, 0, T), zeros(exact, "error", 0, T)]))
    u_cells = np.unique(np.concatenate([cells(exact, 0, T), zeros(exact, "u", 0, T)]))
    tail = exact.signals(np.linspace(T / 2, T, 2001))["error"]
    tail_cells = e_cells[e_cells >= T / 2]
    u = exact.signals(np.sort(np.concatenate([u_cells, np.nextafter(exact.switching_times, 0.0)])))["u"]
    return {
        "iae": integral(exact, lambda t, q: np.abs(q["error"]), e_cells),
        "ise": integral(exact, lambda t, q: q["error"] ** 2, e_cells),
        "itae": integral(exact, lambda t, q: t * np.abs(q["error"]), e_cells),
        "energy": integral(exact, lambda t, q: q["u"] ** 2, u_cells),
        "effort": integral(exact, lambda t, q: np.abs(q["u"]), u_cells),
        "peak": float(np.abs(u).max()),
        "total_variation": total_variation(exact),
        "tail_rms": float(np.sqrt(integral(exact, lambda t, q: q["error"] ** 2, tail_cells) / (T - tail_cells[0]))),
        "tail_max": float(np.abs(tail).max()),
        "tail_total_variation": total_variation(exact, T / 2, T),
    }
