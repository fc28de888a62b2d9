"""The uncertainty of a plant as sets and expressions: which theta are admissible, and what a bound has to hold against.

Bounds in the sense of `mfc_gym.nominal`: each is abs(numerator / denominator) <= bound with a denominator of 1 or
1 + Delta_3, over the operating region and every admissible theta.
"""

from functools import cached_property

import sympy as sp

from mfc_gym.branch_and_bound import Box, enclose
from mfc_gym.flat_system import INPUT_LIMIT, FlatSystem
from mfc_gym.interval_function import Ends, IntervalFunction
from mfc_gym.triangle import ROUNDING, ThetaSet, round_up


def region_box(system: FlatSystem) -> dict[sp.Symbol, Ends]:
    """The operating region at the task's input limit, rounded outward."""
    limit = {INPUT_LIMIT: sp.Rational(system.task.input_limit)}
    box = {}
    for x, interval in zip(system.x, system.region.values(), strict=True):
        (low, _), (_, high) = IntervalFunction([sp.sympify(e).subs(limit) for e in interval], ())([])
        if not float("-inf") < low < high < float("inf"):
            raise ValueError(f"`region` must have low < high for {x}, got [{interval[0]}, {interval[1]}].")
        box[x] = (low, high)
    return box


class Uncertainty:
    """Delta_1, Delta_3 and phi_m of a plant, with the box of states and uncertain constants they are taken over."""

    def __init__(self, system: FlatSystem) -> None:
        self.system = system
        self.region: Box = region_box(system)
        self.theta_box: Box = {
            s: (float(a), float(b)) for s, (a, b) in zip(system.theta_symbols, system.theta.values(), strict=True)
        }
        self.box: Box = {**self.region, **self.theta_box}
        self.Delta_1 = system.Delta_1
        self.Delta_3 = system.Delta_3
        self.delta_3 = system.bounds.get("delta_3")  # None: not declared
        self.gate = system.gate  # its Delta_3 and delta_3 say which theta are admissible
        self.gate_3 = self.gate.Delta_3
        self.gate_limit = self.gate.bounds.get("delta_3")

    @cached_property
    def range_3(self) -> Ends:
        """Range of Delta_3 over the region and the whole theta box."""
        return enclose(self.Delta_3, self.box, budget=100_000)

    @property
    def uniform(self) -> bool:
        """Whether Delta_3 is the same at every state, so that delta_3 says which theta is admissible."""
        return not self.Delta_3.free_symbols & set(self.region)

    @property
    def is_gate(self) -> bool:
        """Whether delta_3 is what makes a theta admissible, rather than a bound to be proved."""
        return self.uniform and self.gate is self.system

    @cached_property
    def limit_3(self) -> float | None:
        """Upper bound of delta_3 if it excludes a part of the theta box, None if the whole box is admissible."""
        if self.gate_limit is None or self.gate_3.free_symbols & set(self.region):
            return None
        limit = enclose(self.gate_limit, self.region)[1]
        low, high = self.range_3 if self.gate is self.system else enclose(self.gate_3, self.box, budget=100_000)
        return None if max(-low, high) <= limit * (1 + ROUNDING) else limit

    @property
    def theta(self) -> ThetaSet:
        """The admissible theta: the part of the box where abs(Delta_3) <= delta_3 (all of it if that depends on the state)."""
        limit = self.limit_3
        return ThetaSet(self.theta_box) if limit is None else ThetaSet(self.theta_box, self.gate_3, sp.Rational(limit))

    @property
    def where(self) -> list[sp.Expr]:
        """Expressions that are <= 0 at every admissible theta, and nowhere else but for a rounding."""
        if self.limit_3 is None:
            return []
        limit = self.gate_limit * (1 + sp.Rational(ROUNDING))
        return [self.gate_3 - limit, -self.gate_3 - limit]

    def least_gain(self, delta_3: sp.Expr) -> sp.Expr:
        """A lower bound of 1 + Delta_3 for admissible theta, delta_3 bounding abs(Delta_3)."""
        low = max(self.range_3[0], -enclose(delta_3, self.region, budget=40_000)[1])
        return 1 - round_up(-low)

    def quotient(self, bound: str) -> tuple[sp.Expr, sp.Expr]:
        """(numerator, denominator) of what `bound` bounds."""
        one = sp.S.One
        return {
            "delta_1": (self.Delta_1, one),
            "delta_3": (self.Delta_3, one),
            "delta_m": (self.system.phi_m, one),
            "sharp_1": (self.Delta_1, one + self.Delta_3),
            "sharp_3": (self.Delta_3, one + self.Delta_3),
        }[bound]

    def require_theta(self) -> None:
        """Refuse a delta_3 that no theta meets; without one, a theta box that reaches abs(Delta_3) >= 1.

        The latter names theta and the nominal input gain that would do better.
        """
        low, high = self.range_3
        if self.delta_3 is not None:
            limit = self.limit_3 if self.gate is self.system else None
            if limit is not None and (low > limit or high < -limit):
                raise ValueError(
                    f"`bounds` delta_3 = {self.delta_3} must admit some theta, none has abs(Delta_3) <= delta_3."
                )
            return
        if max(-low, high) < 1:
            return
        gain_low, gain_high = 1 + low, 1 + high
        names = sorted(s.name for s in self.Delta_3.free_symbols if s in self.theta_box)
        sets = ", ".join(f"{name} in {list(self.system.theta[name])}" for name in names)
        middle = (gain_low + gain_high) / 2
        remedy = (
            f"choose the nominal parameters so that the nominal input gain is {middle:.4g} times the present one "
            f"(then abs(Delta_3) <= {(gain_high - gain_low) / (2 * middle):.4g}), or narrow the interval"
            if gain_low > 1e-9 and gain_high < float("inf")
            else "narrow the interval"
        )
        raise ValueError(
            f"`theta` must keep abs(Delta_3) < 1, but with {sets or 'the given Delta'} the true input gain ranges over "
            f"[{gain_low:.4g}, {gain_high:.4g}] times the nominal one: {remedy}."
        )
