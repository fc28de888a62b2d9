"""The controllers by name. A new one is one line in the table."""

from collections.abc import Callable
from typing import Any

from baselines.controller import Controller
from baselines.redesign import redesign
from mfc_gym.nominal import NominalModel

Factory = Callable[..., Controller]


def mfc(nominal: NominalModel, **options: Any) -> Controller:
    """The reference policy: model-following control with the model loop in Brunovsky form, eq. (18) of [1]."""
    return redesign("mfc", nominal, **options)


def mfc_conventional(nominal: NominalModel, **options: Any) -> Controller:
    """The same with the nonlinear model and its own linearising law, Fig. 1 of [1]."""
    return redesign("mfc-conventional", nominal, model="nonlinear", **options)


def single_loop(nominal: NominalModel, **options: Any) -> Controller:
    """Without a model loop: the reference is the model, eq. (25) of [1]."""
    return redesign("single-loop", nominal, model="reference", **options)


def matched_only(nominal: NominalModel, **options: Any) -> Controller:
    """What [1] compares with: xi in place of xi_n and the gain for matched uncertainty, eq. (24)."""
    return redesign("matched-only", nominal, **({"feedback": "state", "gain": "matched"} | options))


CONTROLLERS: dict[str, Factory] = {
    "mfc": mfc,
    "mfc-conventional": mfc_conventional,
    "single-loop": single_loop,
    "matched-only": matched_only,
}


def names() -> tuple[str, ...]:
    """Names of all controllers."""
    return tuple(CONTROLLERS)


def build(name: str, nominal: NominalModel, /, **options: Any) -> Controller:
    """The controller `name` for this nominal model. Raises ValueError for an unknown name or options it does not take."""
    if name not in CONTROLLERS:
        raise ValueError(f"`name` must be one of {sorted(CONTROLLERS)}, got {name!r}.")
    try:
        return CONTROLLERS[name](nominal, **options)
    except TypeError as error:
        raise ValueError(f"controller {name!r} does not take these options: {error}.") from error


def make(name: str, env: Any, **options: Any) -> Controller:
    """The controller `name` for this environment (scalar or vector), which tells it the nominal model and nothing else."""
    return build(name, env.unwrapped.nominal, **options)
