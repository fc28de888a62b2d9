"""A plant, ready to run: its compiled kernels and its declaration, found by name without touching SymPy when cached."""

import importlib
import importlib.util
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache, cached_property, partial
from inspect import signature
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mfc_gym import kernels
from mfc_gym.systems import SYSTEMS
from mfc_gym.task import Task
from mfc_gym.variation import PLAIN, Variation

if TYPE_CHECKING:
    from mfc_gym.flat_system import FlatSystem

Array = NDArray[np.float64]
GENERATORS = (  # the modules that take part in writing kernels
    *("flat_system", "code_generation", "task", "plant_file", "expressions", "complexity", "size"),
    *("enclosure", "interval", "interval_function", "branch_and_bound"),
    *("domain", "falsification", "termwise", "triangle", "uncertainty"),
    *("plant_entries", "toml_lines", "variation", "varying"),
)
OWN: dict[str, "FlatSystem"] = {}  # the plants of `mfc_gym.register_system` by name


@dataclass(frozen=True)
class Plant:
    """The true plant. `kernel` holds f + g u + Delta and tau_n; `nominal` what a controller may know."""

    name: str
    options: Mapping[str, Any]
    kernel: ModuleType
    nominal: ModuleType
    variation: Variation

    @property
    def order(self) -> int:
        return len(self.kernel.STATE)

    @property
    def state(self) -> tuple[str, ...]:
        return tuple(self.kernel.STATE)

    @property
    def theta(self) -> tuple[str, ...]:
        """Names of the declared uncertain parameters, p of them."""
        return self.parameters[: self.kernel.DECLARED]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of all uncertain parameters: the declared ones, then disturbances and rates of what moves."""
        return tuple(self.kernel.THETA)

    @property
    def parameter_set(self) -> tuple[Array, Array]:
        """(low, high) of the sets of all uncertain parameters."""
        return np.array(self.kernel.THETA_LOW), np.array(self.kernel.THETA_HIGH)

    @property
    def theta_set(self) -> tuple[Array, Array]:
        """(low, high) of the declared set, each of shape (p,)."""
        low, high = self.parameter_set
        return low[: len(self.theta)], high[: len(self.theta)]

    @property
    def task(self) -> Task:
        return self.kernel.TASK

    def region(self, input_limit: float) -> tuple[Array, Array]:
        """(low, high) of the operating region, each of shape (n,); unit of the state."""
        low, high = self.kernel.region(input_limit)
        return np.array(low, dtype=float), np.array(high, dtype=float)

    @cached_property
    def system(self) -> "FlatSystem":
        """The equations themselves (imports SymPy)."""
        return _vary(build_system(self.name, self.options), self.variation)


def build_system(name: str, options: Mapping[str, Any]) -> "FlatSystem":
    """The FlatSystem behind a registered name, a "module:attribute" or a plant file.

    Raises ValueError for an unknown name or options the plant does not take.
    """
    if name in OWN:
        if options:
            raise ValueError(f"a registered system takes no options, got {sorted(options)}.")
        return OWN[name]
    if name.endswith(".toml"):
        from mfc_gym.plant_file import load_plant

        if options:
            raise ValueError(f"a plant file takes no options, got {sorted(options)}.")
        return load_plant(name)
    module, _, attribute = _location(name).partition(":")
    make = getattr(importlib.import_module(module), attribute, None)
    if not callable(make):
        raise ValueError(f"`system` must name a function of the module {module}, got {name!r}.")
    try:
        signature(make).bind(**options)
    except TypeError as error:
        known = ", ".join(signature(make).parameters) or "none"
        raise ValueError(
            f"neither the environment (options: help(mfc_gym.settings.Settings)) nor its system {name!r} (options: {known}) "
            f"takes what is given: {error}."
        ) from error
    try:
        system: FlatSystem = make(**options)
    except TypeError as error:
        raise ValueError(f"options of system {name!r} must fit it, got {options}: {error}.") from error
    return system


def load(name: str, variation: Variation = PLAIN, **options: Any) -> Plant:
    """The plant `name`, varied, with its kernels compiled or from the cache. Raises ValueError if there is no such plant."""
    here = Path(__file__)
    sources = [p for p in (here.with_name(f"{module}.py") for module in GENERATORS) if p.exists()]
    sources += sorted(here.with_name("systems").glob("*.py"))
    text = ""
    if name in OWN:
        text = OWN[name].text
    elif str(name).endswith(".toml"):
        path = Path(name)
        if not path.is_file():
            raise ValueError(f"`system` must be a plant file or a registered name, there is no file {name!r}.")
        with path.open("rb") as file:  # a module is imported once, a file may change while the process runs
            text = file.read(1 << 17).hex()  # longer ones are refused
    else:
        sources.append(_module_file(name))
    try:
        given = json.dumps(options, sort_keys=True)
    except (TypeError, ValueError) as error:
        raise ValueError(f"options of the system must be numbers, strings, lists or dicts, got {options}.") from error
    varied = json.dumps(asdict(variation), sort_keys=True)
    hashed = kernels.key(kernels.fingerprint(*sources), name, given, text, varied)

    @cache
    def system() -> "FlatSystem":
        return _vary(build_system(name, options), variation)

    def source(kind: str) -> str:
        from mfc_gym import code_generation

        return getattr(code_generation, f"{kind}_source")(system())

    kernel, nominal = (kernels.load(f"mfc_{kind}_{hashed}", partial(source, kind)) for kind in ("plant", "nominal"))
    return Plant(name, options, kernel, nominal, variation)


def _vary(system: "FlatSystem", variation: Variation) -> "FlatSystem":
    if variation == PLAIN:
        return system
    from mfc_gym.varying import varied

    return varied(system, variation)


def _location(name: str) -> str:
    location = SYSTEMS.get(name, name) if isinstance(name, str) else ""
    if ":" not in location:
        raise ValueError(
            f"`system` must be one of {sorted([*SYSTEMS, *OWN])}, a module:attribute or a .toml file, got {name!r}."
        )
    return location


def _module_file(name: str) -> Path:
    module = _location(name).partition(":")[0]
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        spec = None
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        raise ValueError(f"`system` must name an importable module, got {name!r}.")
    return Path(spec.origin)
