"""The controllers by name. A new one is one line in the table."""

from collections.abc import Callable, Mapping
from functools import partial
from inspect import signature
from typing import Any

from baselines.controller import Controller
from baselines.redesign import redesign
from mfc_gym.checks import one_of
from mfc_gym.nominal import NominalModel

Factory = Callable[..., Controller]

CONTROLLERS: dict[str, Factory] = {
    # the reference policy: model-following control with the model loop in Brunovsky form, eq. (18) of [1]
    "mfc": partial(redesign, "mfc"),
    # the same with the nonlinear model and its own linearising law, Fig. 1 of [1]
    "mfc-conventional": partial(redesign, "mfc-conventional", model="nonlinear"),
    # without a model loop: the reference is the model, eq. (25) of [1]
    "single-loop": partial(redesign, "single-loop", model="reference"),
    # what [1] compares with: xi in place of xi_n and the gain for matched uncertainty, eq. (24)
    "matched-only": partial(redesign, "matched-only", feedback="state", gain="matched"),
}


def names() -> tuple[str, ...]:
    """Names of all controllers."""
    return tuple(CONTROLLERS)


def build(name: str, nominal: NominalModel, /, **options: Any) -> Controller:
    """The controller `name` for this nominal model. Raises ValueError for an unknown name or options it does not take."""
    one_of("name", name, CONTROLLERS)
    return call(name, CONTROLLERS[name], nominal, options)


def call(name: str, factory: Factory, nominal: NominalModel, options: Mapping[str, Any]) -> Controller:
    """factory(nominal, **options). Raises ValueError naming the options it takes if these are others."""
    try:
        signature(factory).bind(nominal, **options)
    except TypeError as error:
        known = ", ".join(list(signature(factory).parameters)[1:]) or "none"
        raise ValueError(f"controller {name!r} does not take these options: {error}; it takes {known}.") from error
    return factory(nominal, **options)


def make(name: str, env: Any, **options: Any) -> Controller:
    """The controller `name` for this environment (scalar or vector), which tells it the nominal model and nothing else."""
    nominal = getattr(getattr(env, "unwrapped", None), "nominal", None)
    if not isinstance(nominal, NominalModel):
        raise ValueError(f"`env` must be an environment of mfc_gym, scalar or vector, got {env!r}.")
    return build(name, nominal, **options)
