"""Differentially flat systems with a possibly unmatched uncertainty, eq. (1) of [1].

[1] Tietze, Wulff, Reger: Trajectory tracking model-following control using Lyapunov redesign with output
    time-derivatives to compensate unmatched uncertainties.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from math import isfinite
from numbers import Real
from typing import TypeAlias

import sympy as sp
from sympy.core.function import AppliedUndef

from mfc_gym.size import is_short
from mfc_gym.task import Task

INPUT_LIMIT = sp.Symbol("input_limit", positive=True)  # may stand in a bound of the operating region
BOUNDS = ("delta_1", "delta_3", "delta_m", "sharp_1", "sharp_3")
NOT_REAL = (sp.nan, sp.oo, -sp.oo, sp.zoo, sp.I)

Expression: TypeAlias = sp.Expr | float


def lie(field: Iterable[sp.Expr], phi: sp.Expr, state: Iterable[sp.Symbol]) -> sp.Expr:
    """Lie derivative L_field phi."""
    return sp.Add(*(sp.diff(phi, x) * v for x, v in zip(state, field, strict=True)))


def is_zero(expression: sp.Expr) -> bool:
    """Identity test: zero to 30 digits at five points in general position, then multiplied out or simplified as well."""
    symbols = sorted(expression.free_symbols, key=lambda s: s.name)
    for i in range(1, 6):
        point = {s: sp.Rational(7 * i + 3 * j + 1, 11 + i * j) for j, s in enumerate(symbols)}
        value = expression.subs(point).evalf(30)
        if value.is_finite and abs(value) > sp.Float("1e-20"):
            return False
    expanded = sp.expand(expression)
    return bool(expanded == 0 or sp.simplify(expanded) == 0)


def _is_finite(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)


@dataclass(frozen=True, eq=False)
class FlatSystem:
    """x' = f(x) + g(x) u + Delta(x), y = h(x): eq. (1) of [1], with everything that follows from it.

    Expressions are SymPy expressions or numbers in the state, the known `parameters` and (in Delta alone) the uncertain
    `theta`. Checked at construction: relative degree n of the nominal system, eq. (2); the same, uniformly, under
    Delta, eq. (3); regular Jacobians of tau and tau_n, eq. (4) and (5).
    """

    name: str
    state: tuple[str, ...]
    f: tuple[Expression, ...]
    g: tuple[Expression, ...]
    h: Expression
    Delta: tuple[Expression, ...]
    parameters: Mapping[str, float] = field(default_factory=dict)  # known constants
    theta: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # uncertain parameters and their intervals
    rates: Mapping[str, str] = field(default_factory=dict)  # theta that move in time -> the theta that is their rate
    region: Mapping[str, tuple[Expression, Expression]] = field(default_factory=dict)  # operating region
    bounds: Mapping[str, Expression] = field(default_factory=dict)  # of the uncertainty, see `mfc_gym.nominal`
    task: Task = field(default_factory=Task)
    origin: "FlatSystem | None" = None  # of which this is a variation, see `mfc_gym.varying`

    def __post_init__(self) -> None:
        n = len(self.state)
        if n < 2:
            raise ValueError(f"`state` must have at least 2 entries, got {self.state}.")
        names = [*self.state, *self.parameters, *self.theta]
        if len(set(names)) != len(names):
            raise ValueError(f"`state`, `parameters` and `theta` must have distinct names, got {names}.")
        for name, value in self.parameters.items():
            if not _is_finite(value):
                raise ValueError(f"`parameters` must be finite numbers, got {name} = {value!r}.")
        for name in ("f", "g", "Delta"):
            entries = getattr(self, name)
            if len(entries) != n:
                raise ValueError(f"`{name}` must have {n} entries, one per state, got {len(entries)}.")
            object.__setattr__(self, name, tuple(self._canonical(name, e) for e in entries))
        object.__setattr__(self, "h", self._canonical("h", self.h))
        object.__setattr__(self, "bounds", {k: self._canonical("bounds", v) for k, v in self.bounds.items()})
        self._check_intervals()
        region = {x: self.region.get(x, (-10.0, 10.0)) for x in self.state}
        region = {x: tuple(self._canonical("region", e) for e in ends) for x, ends in region.items()}
        object.__setattr__(self, "region", region)
        self._check_names()
        self._check_relative_degree()
        self._check_diffeomorphism()

    # -- symbols ------------------------------------------------------------------------------------------------------

    @cached_property
    def x(self) -> tuple[sp.Symbol, ...]:
        return tuple(sp.Symbol(name, real=True) for name in self.state)

    @cached_property
    def theta_symbols(self) -> tuple[sp.Symbol, ...]:
        return tuple(sp.Symbol(name, real=True) for name in self.theta)

    @property
    def order(self) -> int:
        """n, the number of states and the relative degree."""
        return len(self.state)

    def _canonical(self, name: str, given: Expression) -> sp.Expr:
        """The expression in this system's own symbols: real, known parameters replaced by their values."""
        try:
            expression = sp.sympify(given, strict=True)  # strict: text is never evaluated
        except sp.SympifyError:
            expression = None
        if not isinstance(expression, sp.Expr) or expression.has(*NOT_REAL, AppliedUndef):
            raise ValueError(f"`{name}` must hold finite real SymPy expressions or numbers, got {given!r}.")
        values = {name: sp.nsimplify(value, rational=True) for name, value in self.parameters.items()}
        real = {s: values.get(s.name, sp.Symbol(s.name, real=True)) for s in expression.free_symbols - {INPUT_LIMIT}}
        return expression.subs(real)

    def _check_intervals(self) -> None:
        if extra := ({*self.rates, *self.rates.values()}) - set(self.theta):
            raise ValueError(f"`rates` may have the entries {tuple(self.theta)}, got {sorted(extra)}.")
        for name, ends in self.theta.items():
            if len(ends) != 2 or not all(map(_is_finite, ends)) or not ends[0] <= ends[1]:
                raise ValueError(f"`theta` must map names to intervals (low, high), got {name}: {ends!r}.")
        if extra := set(self.region) - set(self.state):
            raise ValueError(f"`region` may have the entries {self.state}, got {sorted(extra)}.")
        for name, ends in self.region.items():
            if len(ends) != 2 or (all(map(_is_finite, ends)) and not ends[0] < ends[1]):
                raise ValueError(f"`region` must map states to intervals (low, high), got {name}: {ends!r}.")

    def _check_names(self) -> None:
        x = set(self.x)
        for name, entries, allowed in (
            ("f", self.f, x),
            ("g", self.g, x),
            ("h", (self.h,), x),
            ("Delta", self.Delta, x | set(self.theta_symbols)),
            ("bounds", self.bounds.values(), x),
            ("region", chain.from_iterable(self.region.values()), {INPUT_LIMIT}),
        ):
            unknown = set(chain.from_iterable(sp.sympify(e).free_symbols for e in entries)) - allowed
            if unknown:
                known, names = sorted(s.name for s in allowed), ", ".join(sorted(s.name for s in unknown))
                raise ValueError(f"`{name}` must be an expression in {known}, it contains {names}.")
        if extra := set(self.bounds) - set(BOUNDS):
            raise ValueError(f"`bounds` may have the entries {BOUNDS}, got {sorted(extra)}.")

    # -- what the nominal model says ----------------------------------------------------------------------------------

    def _lie_series(self, field: tuple[sp.Expr, ...], variables: tuple[sp.Symbol, ...]) -> tuple[sp.Expr, ...]:
        series = [self.h]
        for _ in range(self.order):
            series.append(lie(field, series[-1], variables))
        return tuple(series)

    @cached_property
    def lie_f(self) -> tuple[sp.Expr, ...]:
        """(h, L_f h, ..., L_f^n h)."""
        return self._lie_series(self.f, self.x)

    @property
    def tau(self) -> tuple[sp.Expr, ...]:
        """xi = tau(x), eq. (4) of [1]."""
        return self.lie_f[:-1]

    @property
    def alpha(self) -> sp.Expr:
        """L_f^n h."""
        return self.lie_f[-1]

    @cached_property
    def beta(self) -> sp.Expr:
        """L_g L_f^(n-1) h."""
        return lie(self.g, self.tau[-1], self.x)

    # -- what the uncertainty makes of it -----------------------------------------------------------------------------

    @property
    def text(self) -> str:
        """All that the system is made of; equal texts are equal systems."""
        expressions = (self.f, self.g, self.h, self.Delta, tuple(self.region.items()), tuple(self.bounds.items()))
        plain = (self.name, self.state, dict(self.theta), dict(self.rates), self.task)
        return repr(plain) + sp.srepr(expressions)

    @cached_property
    def lie_f_Delta(self) -> tuple[sp.Expr, ...]:
        """(h, L_(f+Delta) h, ..., L_(f+Delta)^n h): the derivatives of y for u = 0, theta moving at its `rates`."""
        drift = (a + b for a, b in zip(self.f, self.Delta, strict=True))
        symbol = dict(zip(self.theta, self.theta_symbols, strict=True))
        rates = (symbol[name] for name in self.rates.values())
        return self._lie_series((*drift, *rates), (*self.x, *(symbol[name] for name in self.rates)))

    @property
    def tau_n(self) -> tuple[sp.Expr, ...]:
        """xi_n = tau_n(x), the output and its n-1 derivatives, eq. (5) of [1]."""
        return self.lie_f_Delta[:-1]

    @property
    def phi_m(self) -> sp.Expr:
        """Matched uncertainty in transformed coordinates, L_Delta L_f^(n-1) h, eq. (8a) of [1]."""
        return lie(self.Delta, self.tau[-1], self.x)

    @property
    def phi_u(self) -> tuple[sp.Expr, ...]:
        """Unmatched uncertainty in transformed coordinates, (L_Delta L_f^k h for k <= n-2, 0), eq. (8b) of [1]."""
        return (*(lie(self.Delta, phi, self.x) for phi in self.tau[:-1]), sp.Integer(0))

    @property
    def Delta_1(self) -> sp.Expr:
        """L_(f+Delta)^n h - L_f^n h."""
        return self.lie_f_Delta[-1] - self.alpha

    @cached_property
    def Delta_2(self) -> sp.Expr:
        """L_g L_(f+Delta)^(n-1) h - L_g L_f^(n-1) h."""
        return lie(self.g, self.tau_n[-1], self.x) - self.beta

    @property
    def Delta_3(self) -> sp.Expr:
        """Delta_2 normalised by the nominal input gain; a long one that the state is not in stays as it stands."""
        quotient = self.Delta_2 / self.beta
        separate = not is_short(quotient) and not quotient.free_symbols & set(self.x)
        return sp.cancel(quotient) if self.Delta_2.is_rational_function() and not separate else quotient

    @property
    def gate(self) -> "FlatSystem":
        """The system whose Delta_3 and delta_3 say which theta are admissible: the origin of a variation, else this one."""
        return self if self.origin is None else self.origin.gate

    @property
    def decomposition(self) -> tuple[tuple[sp.Expr, ...], tuple[sp.Expr, ...]]:
        """(Delta_m, Delta_u): the part of Delta along g and the part orthogonal to it, eq. (10) of [1]."""
        g = sp.Matrix(self.g)
        Delta = sp.Matrix(self.Delta)
        Delta_m = g * (g.dot(Delta) / g.dot(g))
        return tuple(Delta_m), tuple(sp.simplify(e) for e in Delta - Delta_m)

    # -- assumptions --------------------------------------------------------------------------------------------------

    def _check_relative_degree(self) -> None:
        n = self.order
        for series, label, source in (
            (self.lie_f, "L_g L_f^{k} h", "the nominal system must have relative degree n"),
            (self.lie_f_Delta, "L_g L_(f+Delta)^{k} h", "Delta must keep the relative degree"),
        ):
            for k, phi in enumerate(series[:-1]):
                term = lie(self.g, phi, self.x)
                zero = is_zero(term)
                if zero != (k < n - 1):
                    got = "0" if zero else str(sp.simplify(term))
                    need = "zero" if k < n - 1 else "nonzero"
                    raise ValueError(
                        f"{source} = {n}: {label.format(k=k)} must be {need} (order k = {k}), "
                        f"got {got} in system {self.name!r}."
                    )

    def _check_diffeomorphism(self) -> None:
        for tau, name in ((self.tau, "tau"), (self.tau_n, "tau_n")):
            if is_zero(sp.Matrix(tau).jacobian(self.x).det(method="berkowitz")):
                raise ValueError(
                    f"`{name}` must have a nonsingular Jacobian, its determinant vanishes in system {self.name!r}."
                )
