"""A controller of your own: the nominal model linearised exactly, with all poles of the error at one place.

python scripts/evaluate_controller.py mfc docs.controllers.exact_linearisation:ExactLinearisation:pole=6
"""

import numpy as np

from baselines.controller import Controller
from baselines.lyapunov import place
from mfc_gym import observation as layout


class ExactLinearisation(Controller):
    """u = (y_d^(n) - k' (xi_n - xi_d) - L_f^n h) / L_g L_f^(n-1) h: what is left of the reference policy without switching."""

    name = "exact-linearisation"
    reads = ("state", "output derivatives", "nominal model")
    memory_size = 0

    def __init__(self, nominal, pole=4.0):
        self.nominal, self.k = nominal, place([-pole] * nominal.order)

    def control(self, observations, memory, fresh):
        x, y_d = layout.state(observations), layout.reference(observations)
        error = layout.output_derivatives(observations) - y_d[:, :-1]
        u = (y_d[:, -1] - error @ self.k - self.nominal.alpha(x)) / self.nominal.beta(x)
        return np.clip(u, -self.nominal.input_limit, self.nominal.input_limit)
