"""The tracking reward: minus the integral of a bounded cost."""

from mfc_gym.compiled import njit


@njit
def absolute(error: float, u: float, effort: float) -> float:
    """abs(y - y_d) + effort u^2; with effort = 0 its integral is the IAE."""
    return abs(error) + effort * u * u


@njit
def quadratic(error: float, u: float, effort: float) -> float:
    """(y - y_d)^2 + effort u^2; with effort = 0 its integral is the ISE."""
    return error * error + effort * u * u


@njit
def reward(cost: float, cost_max: float, dt: float, remaining: float) -> float:
    """-dt min(cost, cost_max), and cost_max for every step that remains after leaving the region: leaving never pays.

    `cost` per second, `dt` in s, `remaining` the number of steps left.
    """
    return -dt * (min(cost, cost_max) + cost_max * remaining)


COSTS = {"absolute": absolute, "quadratic": quadratic}
