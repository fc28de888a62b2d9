"""From Stable-Baselines3 to an `Agent`: the actor of a trained model, or of a `.zip`, whose pickled parts are never opened."""

import io
import re
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baselines.agent_schema import MAX_LAYERS, MAX_WIDTH
from baselines.extras import missing
from baselines.interface import Interface
from baselines.policy_network import ACTIVATIONS, Agent, Array, Features, Layer

try:
    import torch
except ModuleNotFoundError as error:
    raise missing("torch", "rl") from error

WEIGHTS = "policy.pth"  # in the .zip
MAX_ZIP = 256 * 2**20  # bytes, of the file and of the weights in it
MAX_MEMBERS = 100
PLAIN = Interface()
RENORM_EPS = 1e-3  # sb3-contrib's BatchRenorm


@dataclass(frozen=True)
class Actor:
    """Where an algorithm keeps its actor: prefixes in the state dictionary, in the order of evaluation."""

    prefixes: tuple[str, ...]
    output: str  # of `baselines.policy_network.OUTPUTS`


ACTORS: dict[str, Actor] = {
    "PPO": Actor(("mlp_extractor.policy_net", "action_net"), "clip"),
    "SAC": Actor(("actor.latent_pi", "actor.mu"), "tanh"),
    "TD3": Actor(("actor.mu",), "tanh"),
    "TQC": Actor(("actor.latent_pi", "actor.mu"), "tanh"),
    "CrossQ": Actor(("actor.latent_pi", "actor.mu"), "tanh"),
}


def agent_of(
    model: Any,
    features: Features,
    environment: Mapping[str, Any],
    training: Mapping[str, Any],
    interface: Interface = PLAIN,
) -> Agent:
    """The actor of a model as it is now; `model.policy.activation_fn` must be one that `Agent` knows."""
    algorithm = type(model).__name__
    activation = (model.policy.activation_fn if algorithm == "PPO" else model.actor.activation_fn).__name__.lower()
    return _agent(algorithm, activation, model.policy.state_dict(), features, environment, training, interface)


def import_sb3_zip(
    path: Path | str, algorithm: str, activation: str, features: Features | None = None, trust: bool = False
) -> Agent:
    """The actor of a Stable-Baselines3 `.zip`: only the tensors of its policy, by PyTorch's weights-only reader.

    A `.zip` states neither its algorithm nor its activation other than in a pickle, which is never read: say them.
    `features`: None if the model was trained on the bare observations. `trust=True` says that you know where it comes from.
    """
    path = Path(path)
    if not trust:
        raise ValueError(
            f"`trust` must be True to open the pickled formats of {path.name}; agent folders need no trust."
        )
    if algorithm not in ACTORS or activation not in ACTIVATIONS:
        known = (sorted(ACTORS), sorted(ACTIVATIONS))
        raise ValueError(f"`algorithm`, `activation` must be one of {known}, got {algorithm!r}, {activation!r}.")
    warnings.warn(f"{path.name}: weights only, read from a format that can hold code.", stacklevel=2)
    state = _state(_member(path))
    if features is None:
        first = min((k for k in state if k.startswith(ACTORS[algorithm].prefixes[0])), key=_position, default=None)
        size = state[first].shape[-1] if first is not None else 1
        features = Features(np.eye(min(size, MAX_WIDTH)), np.zeros(min(size, MAX_WIDTH)))
    return _agent(algorithm, activation, state, features, {}, {"source": path.name})


def _agent(
    algorithm: str,
    activation: str,
    state: Mapping[str, Any],
    features: Features,
    environment: Mapping[str, Any],
    training: Mapping[str, Any],
    interface: Interface = PLAIN,
) -> Agent:
    if algorithm not in ACTORS or activation not in ACTIVATIONS:
        raise ValueError(
            f"`model` must be of {sorted(ACTORS)} with {sorted(ACTIVATIONS)}, got {algorithm}, {activation}."
        )
    layers = _layers(ACTORS[algorithm], state)
    return Agent(algorithm, features, layers, activation, ACTORS[algorithm].output, environment, training, interface)


def _layers(actor: Actor, state: Mapping[str, Any]) -> tuple[Layer, ...]:
    """Linear layers in order; what batch normalisation does before one is a part of it once training is over."""
    layers: list[Layer] = []
    scale: Array | None = None
    shift: Array | None = None
    for prefix in actor.prefixes:
        modules = {k.rpartition(".")[0] for k in state if re.fullmatch(rf"{re.escape(prefix)}(\.\d+)?\.\w+", k)}
        for module in sorted(modules, key=_position):
            own = {k.rpartition(".")[2]: _array(v) for k, v in state.items() if k.rpartition(".")[0] == module}
            if set(own) == {"ra_mean", "ra_var", "steps", "scale", "bias"}:
                scale = own["scale"] / np.sqrt(own["ra_var"] + RENORM_EPS)
                shift = own["bias"] - scale * own["ra_mean"]
            elif set(own) == {"weight", "bias"} and own["weight"].ndim == 2:
                weight, bias = own["weight"], own["bias"]
                if scale is not None and shift is not None:
                    weight, bias = weight * scale, bias + weight @ shift
                layers.append((weight, bias))
                scale = shift = None
            else:
                raise ValueError(f"{module} must be a linear layer, got {sorted(own)}.")
    if not 1 <= len(layers) <= MAX_LAYERS + 1 or not all(np.isfinite(a).all() for layer in layers for a in layer):
        raise ValueError(f"the actor must have 1 to {MAX_LAYERS + 1} finite layers, got {len(layers)}.")
    return tuple(layers)


def _array(tensor: Any) -> Array:
    return np.array(tensor.detach().cpu().numpy(), dtype=float)


def _position(name: str) -> list[int]:
    return [int(part) for part in name.split(".") if part.isdigit()]


def _member(path: Path) -> bytes:
    """The weights in the archive, their size limited whatever the archive declares."""
    try:
        if path.stat().st_size > MAX_ZIP:
            raise ValueError(f"{path.name} must have at most {MAX_ZIP} bytes, got {path.stat().st_size}.")
        with zipfile.ZipFile(path) as archive:
            if len(archive.infolist()) > MAX_MEMBERS:
                raise ValueError(f"{path.name} must hold at most {MAX_MEMBERS} files, got {len(archive.infolist())}.")
            with archive.open(WEIGHTS) as file:
                data = file.read(MAX_ZIP + 1)
    except (OSError, KeyError, zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError) as error:
        raise ValueError(f"`path` must be an SB3 .zip with {WEIGHTS}, got {error}.") from error
    if len(data) > MAX_ZIP:
        raise ValueError(f"{WEIGHTS} must have at most {MAX_ZIP} bytes, got more.")
    return data


def _state(data: bytes) -> dict[str, Any]:
    try:
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # PyTorch raises whatever its unpickler meets
        raise ValueError(f"{WEIGHTS} must hold tensors only, got {type(error).__name__}.") from error
    if not isinstance(state, dict) or not all(isinstance(k, str) and torch.is_tensor(v) for k, v in state.items()):
        raise ValueError(f"{WEIGHTS} must be a dictionary of tensors by name, got {type(state).__name__}.")
    if any(v.ndim > 2 or max(v.shape, default=0) > 2**16 for v in state.values()):
        raise ValueError(f"{WEIGHTS} must hold matrices with at most {2**16} rows and columns, got larger ones.")
    return state
