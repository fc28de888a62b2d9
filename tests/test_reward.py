"""The cost and the reward, and why leaving the operating region never pays."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mfc_gym.reward import COSTS, absolute, quadratic, reward

EPS = float(np.finfo(float).eps)
sizes = st.floats(0, 1e6)
positive = st.floats(1e-3, 1e3)


def test_costs_by_hand() -> None:
    """With dyadic numbers nothing is rounded."""
    assert absolute(-0.5, 4.0, 0.0) == 0.5
    assert absolute(-0.5, 4.0, 0.25) == 4.5
    assert quadratic(-0.5, 4.0, 0.0) == 0.25
    assert quadratic(-0.5, 4.0, 0.25) == 4.25
    assert {"absolute": absolute, "quadratic": quadratic} == COSTS


def test_reward_by_hand() -> None:
    assert reward(2.0, 10.0, 0.5, 0.0) == -1.0
    assert reward(20.0, 10.0, 0.5, 0.0) == -5.0
    assert reward(2.0, 10.0, 0.5, 3.0) == -16.0


@given(cost=sizes, cost_max=positive, dt=positive)
def test_reward_is_bounded(cost: float, cost_max: float, dt: float) -> None:
    assert -dt * cost_max <= reward(cost, cost_max, dt, 0.0) <= 0


@given(costs=st.lists(sizes, min_size=1, max_size=50), cost_max=positive, dt=positive)
def test_leaving_never_pays(costs: list[float], cost_max: float, dt: float) -> None:
    """Whatever happens in the steps that remain, it costs no more than leaving now; the sum rounds len(costs) times."""
    stay = sum(reward(c, cost_max, dt, 0.0) for c in costs)
    leave = reward(costs[0], cost_max, dt, len(costs) - 1.0)
    assert leave <= stay * (1 - 2 * len(costs) * EPS) + len(costs) * np.finfo(float).tiny


@pytest.mark.parametrize("cost", COSTS.values(), ids=COSTS)
@given(error=st.floats(-1e6, 1e6), u=st.floats(-1e6, 1e6), effort=st.floats(0, 10))
def test_costs_are_even_and_least_at_zero(cost: object, error: float, u: float, effort: float) -> None:
    assert cost(0.0, 0.0, effort) == 0
    assert cost(error, u, effort) == cost(-error, -u, effort) >= cost(error, 0.0, effort) >= 0
