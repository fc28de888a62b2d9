"""The layout of the observation vector."""

import numpy as np
import pytest

from mfc_gym import observation


@pytest.mark.parametrize("n", range(2, 8))
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_layout(n: int, batch: tuple[int, ...]) -> None:
    """[x (n), xi_n (n), y_d ... y_d^(n) (n+1)]: the parts are views, in this order, and leave nothing out."""
    vector = np.random.default_rng(n).standard_normal((*batch, observation.size(n)))
    assert observation.order(vector) == n
    parts = [observation.state(vector), observation.output_derivatives(vector), observation.reference(vector)]
    assert [p.shape for p in parts] == [(*batch, n), (*batch, n), (*batch, n + 1)]
    np.testing.assert_array_equal(np.concatenate(parts, axis=-1), vector)
    assert all(np.shares_memory(p, vector) for p in parts)


@pytest.mark.parametrize("shape", [(), (0,), (4,), (6,), (8,), (9,), (3, 5)])
def test_no_order_fits(shape: tuple[int, ...]) -> None:
    """n >= 2 means 7, 10, 13 ... entries."""
    text = f"`observation` must have 3 n \\+ 1 entries on its last axis, got shape \\({str(shape)[1:-1]}\\)"
    with pytest.raises(ValueError, match=text):
        observation.state(np.zeros(shape))
