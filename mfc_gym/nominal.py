"""Everything a controller may know of the plant, and nothing else: the nominal model, the bounds, the sampling time."""

from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NominalModel:
    """x' = f(x) + g(x) u, y = h(x), with bounds on what the true plant adds; neither Delta nor theta is in reach.

    All functions of x take shape (..., n). The bounds hold over the operating region and the admissible theta:

    - delta_1 >= abs(Delta_1) and delta_3 >= abs(Delta_3), eq. (26) of [1];
    - delta_m >= abs(phi_m), all that a controller for matched uncertainty needs;
    - sharp_1 >= abs(Delta_1) / (1 + Delta_3) and sharp_3 >= abs(Delta_3) / (1 + Delta_3): the same uncertainty seen
      through the true input gain, from which the smallest sufficient switching gain follows.
    """

    kernel: ModuleType
    dt: float  # s, sampling time
    input_limit: float
    model_pole: float = 2.0  # 1/s, see `mfc_gym.task`
    process_pole: float = 4.0  # 1/s
    derivatives: str = "exact"  # how xi_n is obtained, see `mfc_gym.settings.Settings`
    noise: float = 0.0  # amplitude of the noise on y, see `mfc_gym.sensors`
    state_noise: float = 0.0  # amplitude of the noise on x

    @property
    def name(self) -> str:
        return str(self.kernel.NAME)

    @property
    def order(self) -> int:
        return int(self.kernel.ORDER)

    def _terms(self, x: Array) -> Array:
        x = np.asarray(x, dtype=float)
        terms = self.kernel.terms_at(np.ascontiguousarray(x.reshape(-1, self.order)))
        return np.asarray(terms.reshape((*x.shape[:-1], terms.shape[-1])))

    def tau(self, x: Array) -> Array:
        """xi = [h, L_f h, ..., L_f^(n-1) h], shape (..., n); eq. (4) of [1]."""
        return self._terms(x)[..., : self.order]

    def alpha(self, x: Array) -> Array:
        """L_f^n h, shape (...)."""
        return self._terms(x)[..., self.order]

    def beta(self, x: Array) -> Array:
        """L_g L_f^(n-1) h, shape (...)."""
        return self._terms(x)[..., self.order + 1]

    def delta_1(self, x: Array) -> Array:
        """Bound of abs(Delta_1), shape (...)."""
        return self._terms(x)[..., self.order + 2]

    def delta_3(self, x: Array) -> Array:
        """Bound of abs(Delta_3), shape (...), dimensionless."""
        return self._terms(x)[..., self.order + 3]

    def spread(self, x: Array) -> Array:
        """Bounds of abs(xi_n - xi) at one point, entry by entry, shape (n,)."""
        return np.asarray(self.kernel.spread_at(np.asarray(x, dtype=float)))

    def f(self, x: Array) -> Array:
        """Nominal drift, shape (..., n)."""
        return self._terms(x)[..., self.order + 7 : 2 * self.order + 7]

    def g(self, x: Array) -> Array:
        """Input vector field, shape (..., n)."""
        return self._terms(x)[..., 2 * self.order + 7 :]

    def tau_jacobian(self, x: Array) -> Array:
        """d tau / dx at one point, shape (n, n)."""
        return np.asarray(self.kernel.jacobian_at(np.asarray(x, dtype=float))).reshape(self.order, self.order)

    def tau_inverse(self, xi: Array, guess: Array | None = None) -> Array:
        """x with tau(x) = xi by Newton's method, shape (n,). Raises ValueError if it does not converge."""
        xi = np.asarray(xi, dtype=float)
        x = np.zeros(self.order) if guess is None else np.array(guess, dtype=float)
        for _ in range(50):
            residual = self.tau(x) - xi
            if not np.isfinite(residual).all():
                break
            if np.abs(residual).max() <= 1e-13 * (1 + np.abs(xi).max()):
                return x
            try:
                x = x - np.linalg.solve(self.tau_jacobian(x), residual)
            except np.linalg.LinAlgError:
                break
        raise ValueError(f"`xi` must be in the range of tau, got {xi} (Newton's method did not converge).")
