"""Agents on disk: a folder with weights as safetensors and everything else as JSON. Loading runs no code of the file.

What is read is data of a known shape: names come from tables, sizes are limited before anything is allocated, every
tensor is compared with the architecture that the JSON declares. Files beside the two are never opened.
"""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from baselines.agent_schema import FIRST_FORMAT, FORMAT, check_agent, parse
from baselines.extras import missing
from baselines.files import replace, write_json
from baselines.interface import Interface
from baselines.observer import Observer
from baselines.policy_network import Agent, Array, Features
from baselines.residual import Base

try:
    from safetensors import SafetensorError
    from safetensors.numpy import load as load_tensors
    from safetensors.numpy import save as save_tensors
except ModuleNotFoundError as error:
    raise missing("safetensors", "rl") from error

DESCRIPTION, WEIGHTS = "agent.json", "weights.safetensors"
MAX_DESCRIPTION = 4 * 2**20  # bytes
MAX_WEIGHTS = 64 * 2**20  # bytes
MAX_HEADER = 64 * 2**10  # bytes of JSON in front of the tensors


def save_agent(agent: Agent, folder: Path) -> None:
    """Write the two files of an agent, each whole or not at all."""
    tensors: dict[str, Any] = {}
    for i, (weight, bias) in enumerate(agent.layers):
        tensors |= {f"layers.{i}.weight": weight.astype(np.float32), f"layers.{i}.bias": bias.astype(np.float32)}
    data = save_tensors(tensors)
    description = {
        "format": FORMAT,
        "algorithm": agent.algorithm,
        "network": {
            "hidden": [len(bias) for _, bias in agent.layers[:-1]],
            "actions": len(agent.layers[-1][1]),
            "activation": agent.activation,
            "output": agent.output,
        },
        "features": {"matrix": agent.features.matrix.tolist(), "offset": agent.features.offset.tolist()},
        "observe": asdict(agent.interface.observer),
        "base": None if agent.interface.base is None else asdict(agent.interface.base),
        "environment": dict(agent.environment),
        "training": dict(agent.training),
        "weights": {"sha256": hashlib.sha256(data).hexdigest()},
    }
    check_agent(description)
    folder.mkdir(parents=True, exist_ok=True)
    replace(folder / WEIGHTS, lambda path: path.write_bytes(data))
    write_json(folder / DESCRIPTION, description)


def load_agent(folder: Path | str, algorithm: str | None = None) -> Agent:
    """The agent in a folder that `save_agent` wrote. Raises ValueError for anything else, before anything is built.

    `algorithm`: the one that the agent must have been trained by, in any case of letters; None: any.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"`folder` must be a folder with {DESCRIPTION} and {WEIGHTS}, got {folder}.")
    description = parse(DESCRIPTION, _read(folder / DESCRIPTION, MAX_DESCRIPTION))
    check_agent(description)
    if algorithm is not None and algorithm.lower() != description["algorithm"].lower():
        raise ValueError(f"`algorithm` must be {description['algorithm']} for the agent in {folder}, got {algorithm}.")
    features = _features(description["features"])
    data = _read(folder / WEIGHTS, MAX_WEIGHTS)
    if hashlib.sha256(data).hexdigest() != description["weights"]["sha256"]:
        raise ValueError(
            f"{WEIGHTS} must have the SHA-256 that {DESCRIPTION} states: it is damaged or another agent's."
        )
    network = description["network"]
    widths = [len(features.offset), *network["hidden"], network["actions"]]
    tensors = _tensors(data, widths)
    layers = tuple((tensors[f"layers.{i}.weight"], tensors[f"layers.{i}.bias"]) for i in range(len(widths) - 1))
    return Agent(
        description["algorithm"],
        features,
        layers,
        network["activation"],
        network["output"],
        description["environment"],
        description["training"],
        _interface(description),
    )


def _interface(description: Mapping[str, Any]) -> Interface:
    """None of the first format's; a controller is only named: `Agent.made_for` builds it."""
    if description["format"] == FIRST_FORMAT:
        return Interface()
    base = description["base"]
    return Interface(
        Observer(**description["observe"]), None if base is None else Base(**base | {"fade": tuple(base["fade"])})
    )


def _read(path: Path, limit: int) -> bytes:
    """The bytes of a plain file of limited size."""
    if path.is_symlink() or not path.is_file():
        raise ValueError(f"{path.name} must be a plain file in the agent's folder, got {_kind(path)}.")
    with path.open("rb") as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise ValueError(f"{path.name} must have at most {limit} bytes, got {path.stat().st_size}.")
    return data


def _kind(path: Path) -> str:
    return "a symbolic link" if path.is_symlink() else "another kind of file" if path.exists() else "none"


def _features(given: Mapping[str, Any]) -> Features:
    rows = {len(row) for row in given["matrix"]}
    if len(rows) != 1 or len(given["matrix"]) != len(given["offset"]):
        raise ValueError("agent.features must be a matrix of equal rows and an offset for each, got other lengths.")
    return Features(np.array(given["matrix"], dtype=float), np.array(given["offset"], dtype=float))


def _tensors(data: bytes, widths: list[int]) -> dict[str, Array]:
    """The tensors by name, after their header has been compared with the layers' widths."""
    expected: dict[str, list[int]] = {}
    for i, (inputs, outputs) in enumerate(pairwise(widths)):
        expected |= {f"layers.{i}.weight": [outputs, inputs], f"layers.{i}.bias": [outputs]}
    size = int.from_bytes(data[:8], "little")
    if len(data) < 8 or size > min(len(data) - 8, MAX_HEADER):
        raise ValueError(
            f"{WEIGHTS} must begin with a header of at most {MAX_HEADER} bytes, got {size} of {len(data)}."
        )
    header = parse(WEIGHTS, data[8 : 8 + size])
    if not isinstance(header, dict) or set(header) != set(expected):
        raise ValueError(f"{WEIGHTS} must hold the tensors {sorted(expected)}, got other names.")
    for name, shape in expected.items():
        entry = header[name] if isinstance(header[name], dict) else {}
        if entry.get("dtype") != "F32" or entry.get("shape") != shape:
            raise ValueError(f"{name} must be float32 of shape {shape}, got {entry.get('dtype')} {entry.get('shape')}.")
    if len(data) != 8 + size + 4 * sum(math.prod(shape) for shape in expected.values()):
        raise ValueError(
            f"{WEIGHTS} must hold the tensors that its header declares and no more, got {len(data)} bytes."
        )
    try:
        tensors = load_tensors(data)
    except SafetensorError as error:
        raise ValueError(f"{WEIGHTS} must be a safetensors file, got {error}.") from error
    for name, tensor in tensors.items():
        if not np.isfinite(tensor).all():
            raise ValueError(f"{name} must be finite, got NaN or inf.")
    return {name: tensor.astype(float) for name, tensor in tensors.items()}
