"""SymPy -> the source text of two modules per plant: the true plant, and the nominal model a controller may know."""

from collections.abc import Iterable, Sequence

import sympy as sp
from sympy.printing.pycode import PythonCodePrinter

from mfc_gym.enclosure import bound_of
from mfc_gym.flat_system import BOUNDS, INPUT_LIMIT, FlatSystem
from mfc_gym.uncertainty import Uncertainty

HEADER = '''"""Generated from the equations of a plant. Do not edit."""

import math

import numpy as np
from mfc_gym.compiled import entry, njit
from mfc_gym.task import Task
'''
SCALAR = '@njit(error_model="numpy")'  # a division by zero gives inf, as any overflow does
INLINED = (
    '@njit(error_model="numpy", forceinline=True)'  # the compiler works on many rows at once only where no call is left
)


class KernelPrinter(PythonCodePrinter):
    """Small integer powers as products, numbers as floats: the same arithmetic everywhere, and fast."""

    def _print_Pow(self, expr: sp.Pow, rational: bool = False) -> str:
        base, exponent = expr.args
        if exponent.is_Integer and 2 <= abs(exponent) <= 8:
            product = "*".join([f"({self._print(base)})"] * abs(int(exponent)))
            return f"({product})" if exponent > 0 else f"(1.0/({product}))"
        return str(super()._print_Pow(expr, rational))

    def _print_Integer(self, expr: sp.Integer) -> str:
        return f"{int(expr)}.0" if expr >= 0 else f"({int(expr)}.0)"

    def _print_Rational(self, expr: sp.Rational) -> str:
        return f"({float(expr)!r})"

    def _print_Float(self, expr: sp.Float) -> str:
        return f"({float(expr)!r})"


def _tuple(entries: Iterable[str]) -> str:
    return "(" + ", ".join(entries) + ",)"


def function(name: str, arguments: Sequence[str], expressions: Sequence[sp.Expr], doc: str) -> str:
    """Source of a scalar function that returns the tuple of expressions, common subexpressions shared."""
    printer = KernelPrinter({"fully_qualified_modules": True})
    shared, results = sp.cse(list(expressions), symbols=sp.numbered_symbols("_c"))
    lines = [f"    {symbol} = {printer.doprint(value)}" for symbol, value in shared]
    body = "\n".join([*lines, f"    return {_tuple(printer.doprint(r) for r in results)}"])
    return f'\n\n{SCALAR}\ndef {name}({", ".join(arguments)}):\n    """{doc}"""\n{body}\n'


def array_function(name: str, calls: Sequence[str], arguments: str, unpack: str, size: int, doc: str) -> str:
    """Source of the entry that Python calls: the concatenated results of scalar functions, as one array."""
    sums = " + ".join(calls)
    return (
        f'\n\n@njit(cache=True, nogil=True)\ndef {name}({arguments}):\n    """{doc}"""\n    {unpack}\n'
        f"    out = np.empty({size})\n    for i, value in enumerate({sums}):\n        out[i] = value\n    return out\n"
    )


def _renamed(system: FlatSystem) -> tuple[list[str], list[str], dict[sp.Symbol, sp.Symbol]]:
    x = [f"x{i + 1}" for i in range(system.order)]
    theta = [f"theta{i + 1}" for i in range(len(system.theta))]
    old = [*system.x, *system.theta_symbols]
    return x, theta, {s: sp.Symbol(name, real=True) for s, name in zip(old, [*x, *theta], strict=True)}


def plant_source(system: FlatSystem) -> str:
    """The true plant: vector field, integrator, tau_n, and what the exact solution and the tests need."""
    n = system.order
    x, theta, names = _renamed(system)

    def rename(entries: Iterable[sp.Expr]) -> list[sp.Expr]:
        return [sp.sympify(e).xreplace(names) for e in entries]

    u = sp.Symbol("u", real=True)
    drift = [a + b for a, b in zip(system.f, system.Delta, strict=True)]
    field = [a + u * b for a, b in zip(drift, system.g, strict=True)]
    tau_jacobian = sp.Matrix(system.tau).jacobian(system.x)
    unpack = f"{_tuple([*x, *theta])} = {_tuple([*(f'x[{i}]' for i in range(n)), *(f'theta[{i}]' for i in range(len(theta)))])}"
    arguments = [*x, *theta]
    call = f"({', '.join(arguments)})"
    printer = KernelPrinter({"fully_qualified_modules": True})
    low, high = (_tuple(printer.doprint(ends[i]) for ends in system.region.values()) for i in (0, 1))
    return "".join(
        [
            HEADER,
            f"\nNAME = {system.name!r}\nSTATE = {tuple(system.state)!r}\nTHETA = {tuple(system.theta)!r}\n",
            f"DECLARED = {len(system.gate.theta)}\n",
            f"THETA_LOW = {tuple(float(low) for low, _ in system.theta.values())!r}\n",
            f"THETA_HIGH = {tuple(float(high) for _, high in system.theta.values())!r}\n",
            f"TASK = {system.task!r}\n",
            f'\n\ndef region({INPUT_LIMIT}):\n    """(low, high) of the operating region."""\n'
            f"    return {low}, {high}\n",
            function("field", [*x, *theta, "u"], rename(field), "f + g u + Delta."),
            function("output_derivatives", arguments, rename(system.tau_n), "xi_n = tau_n(x)."),
            function("drift", arguments, rename(drift), "f + Delta."),
            function("coordinates", arguments, rename(system.tau), "xi = tau(x)."),
            function("input_field", arguments, rename(system.g), "g."),
            function(
                "output_rate",
                arguments,
                rename([system.lie_f_Delta[-1], system.beta + system.Delta_2]),
                "y^(n) = first + second u.",
            ),
            function("coordinate_drift", arguments, rename(tau_jacobian * sp.Matrix(drift)), "Rate of xi for u = 0."),
            function("coordinate_input", arguments, rename(tau_jacobian * sp.Matrix(system.g)), "Rate of xi per u."),
            function(
                "uncertainty",
                arguments,
                rename([system.Delta_1, system.Delta_3, system.phi_m]),
                "Delta_1, Delta_3, phi_m.",
            ),
            function(
                "admissibility",
                arguments,
                rename([system.gate.Delta_3, complete_bounds(system.gate)["delta_3"], system.Delta_3]),
                "Delta_3 and delta_3 that say which theta are admissible, and Delta_3 itself.",
            ),
            _integrator(x, theta),
            '\n\n@entry("void(float64[:, ::1], float64[:, ::1], float64[::1], float64, int64, float64[::1], float64[::1], '
            'float64[:, ::1])")\ndef integrate_all(states, thetas, u, h, substeps, low, high, out):\n'
            '    """(State after the substeps, 1.0 if it stayed inside) of each row."""\n    for k in range(out.shape[0]):\n'
            f"        x, theta = states[k], thetas[k]\n        {unpack}\n"
            f"        {', '.join(f'out[k, {i}]' for i in range(n))}, inside = "
            f"integrate({', '.join(arguments)}, u[k], h, substeps, low, high)\n"
            f"        out[k, {n}] = 1.0 if inside else 0.0\n",
            '\n\n@entry("void(float64[:, ::1], float64[:, ::1], float64[:, ::1])")\n'
            'def output_derivatives_all(states, thetas, out):\n    """tau_n(x) of each row."""\n'
            f"    for k in range(out.shape[0]):\n        x, theta = states[k], thetas[k]\n        {unpack}\n"
            f"        {', '.join(f'out[k, {i}]' for i in range(n))}, = output_derivatives{call}\n",
            array_function(
                "uncertainty_at", [f"uncertainty{call}"], "x, theta", unpack, 3, "(Delta_1, Delta_3, phi_m)."
            ),
            array_function(
                "flow_at",
                [
                    f"{part}{call}"
                    for part in (
                        "drift",
                        "input_field",
                        "output_derivatives",
                        "coordinates",
                        "coordinate_drift",
                        "coordinate_input",
                        "output_rate",
                    )
                ],
                "x, theta",
                unpack,
                6 * n + 2,
                "(drift, g, xi_n, xi, rate of xi without and per input, y^(n) without and per input).",
            ),
        ]
    )


def _integrator(x: list[str], theta: list[str]) -> str:
    """Source of RK4 under a held input, stages unrolled over the state; stops at the first substep outside the region.

    Where that substep ends outside twice the region, too, the state before it is returned: the caller's state stays bounded.
    """
    state, parameters, limits = ", ".join(x), "".join(f"{name}, " for name in theta), range(len(x))

    def stage(k: str, point: Sequence[str]) -> str:
        return f"    {_tuple(k + s for s in x)} = field({', '.join([*point, *theta, 'u'])})"

    def shifted(k: str, factor: str) -> list[str]:
        return [f"{s} + {factor} * {k}{s}" for s in x]

    return "\n".join(
        [
            f"\n\n{INLINED}\ndef rk4({state}, {parameters}u, h):",
            '    """State after one Runge-Kutta step of size h under constant u."""',
            stage("a", x),
            stage("b", shifted("a", "0.5 * h")),
            stage("c", shifted("b", "0.5 * h")),
            stage("d", shifted("c", "h")),
            f"    return {_tuple(f'{s} + h / 6.0 * (a{s} + 2.0 * (b{s} + c{s}) + d{s})' for s in x)}",
            f"\n\n{INLINED}\ndef is_inside({state}, low, high):",
            '    """Whether the state lies in the region."""',
            f"    return {' & '.join(f'(low[{i}] <= {x[i]}) & ({x[i]} <= high[{i}])' for i in limits)}",
            f"\n\n{INLINED}\ndef is_near({state}, low, high):",
            '    """Whether the state lies in twice the region."""',
            f"    return {' & '.join(f'(abs({x[i]} - 0.5 * (low[{i}] + high[{i}])) < high[{i}] - low[{i}])' for i in limits)}",
            f"\n\n{SCALAR}\ndef integrate({state}, {parameters}u, h, substeps, low, high):",
            '    """State after `substeps` RK4 steps of size h under constant u, and whether it stayed inside the region."""',
            "    for _ in range(substeps):",
            f"        {_tuple('n' + s for s in x)} = rk4({state}, {parameters}u, h)",
            f"        if not is_inside({', '.join('n' + s for s in x)}, low, high):",
            f"            if is_near({', '.join('n' + s for s in x)}, low, high):",
            f"                return {', '.join('n' + s for s in x)}, False",
            f"            return {state}, False",
            f"        {_tuple(x)} = {_tuple('n' + s for s in x)}",
            f"    return {state}, True\n",
        ]
    )


def nominal_source(system: FlatSystem) -> str:
    """The nominal model: tau, alpha, beta, f, g and the bounds; neither Delta nor theta stands in it."""
    n = system.order
    x, _, names = _renamed(system)

    def rename(entries: Iterable[sp.Expr]) -> list[sp.Expr]:
        return [sp.sympify(e).xreplace(names) for e in entries]

    bounds = complete_bounds(system)
    unpack = f"{_tuple(x)} = {_tuple(f'x[{i}]' for i in range(n))}"
    call = f"({', '.join(x)})"
    jacobian = sp.Matrix(system.tau).jacobian(system.x)
    parts = ["coordinates", "lie_terms", "bounds", "nominal_drift", "input_field"]
    return "".join(
        [
            HEADER.replace("entry, ", "").replace("from mfc_gym.task import Task\n", ""),
            f"\nNAME = {system.name!r}\nSTATE = {tuple(system.state)!r}\nORDER = {n}\n",
            f"EQUATIONS = {{'f': {tuple(map(str, system.f))!r}, 'g': {tuple(map(str, system.g))!r}, 'h': {str(system.h)!r}}}\n",
            function("coordinates", x, rename(system.tau), "xi = tau(x)."),
            function(
                "lie_terms", x, rename([system.alpha, system.beta]), "(alpha, beta) = (L_f^n h, L_g L_f^(n-1) h)."
            ),
            function("bounds", x, rename([bounds[k] for k in BOUNDS]), ", ".join(BOUNDS) + "."),
            function("nominal_drift", x, rename(system.f), "f."),
            function("input_field", x, rename(system.g), "g."),
            function("spread", x, rename(spread(system)), "Bounds of abs(xi_n - xi), entry by entry."),
            function("jacobian", x, rename(list(jacobian)), "d tau / dx, row by row."),
            array_function("spread_at", [f"spread{call}"], "x", unpack, n, "Bounds of abs(xi_n - xi)."),
            array_function("jacobian_at", [f"jacobian{call}"], "x", unpack, n * n, "d tau / dx, flat."),
            '\n\n@njit(cache=True, nogil=True)\ndef terms_at(points):\n    """(tau, alpha, beta, bounds, f, g) of each row."""\n'
            f"    out = np.empty((points.shape[0], {3 * n + 2 + len(BOUNDS)}))\n"
            "    for k in range(points.shape[0]):\n        x = points[k]\n"
            f"        {unpack}\n"
            f"        for i, value in enumerate({' + '.join(part + call for part in parts)}):\n"
            "            out[k, i] = value\n    return out\n",
        ]
    )


def spread(system: FlatSystem) -> list[sp.Expr]:
    """Bounds of abs(tau_n - tau) over region and admissible theta, entry by entry; inf where none was found."""
    u = Uncertainty(system)

    def bound(change: sp.Expr) -> sp.Expr:
        try:
            return bound_of(u, "spread", change)
        except ValueError:
            return sp.oo

    return [bound(a - b) for a, b in zip(system.tau_n, system.tau, strict=True)]


def complete_bounds(system: FlatSystem) -> dict[str, sp.Expr]:
    """The declared bounds, the others from them: delta_m = delta_1; the sharp ones from the worst Delta_3."""
    declared = dict(system.bounds)
    missing = [k for k in ("delta_1", "delta_3") if k not in declared]
    if missing:
        raise ValueError(
            f"`bounds` must give delta_1 and delta_3, {', '.join(missing)} missing in system {system.name!r}."
        )
    worst = 1 - declared["delta_3"]
    derived = {
        "delta_m": declared["delta_1"],
        "sharp_1": declared["delta_1"] / worst,
        "sharp_3": declared["delta_3"] / worst,
    }
    return derived | declared
