"""A training as it is, in one file: networks, optimisers, replay buffer, curve; plain tensors and numbers, unpickled as such.

No random state is in it: every segment of a training begins with new episodes and random numbers of its own seed, so a
resumed training is, number for number, the one that was never interrupted.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from baselines.files import replace

BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def save(path: Path, model: Any, further: dict[str, Any]) -> None:
    """Write the model and further plain data, whole or not at all."""
    variables = {name: getattr(model, name).detach() for name in model._get_torch_save_params()[1]}
    state = {
        "parameters": model.get_parameters(),
        "variables": variables,
        "num_timesteps": model.num_timesteps,
        "updates": model._n_updates,
        "buffer": _buffer(model),
        "further": further,
    }
    replace(path, lambda target: torch.save(state, target))


def restore(path: Path, model: Any) -> dict[str, Any]:
    """Put what `save` wrote into a model built with the same arguments; returns the further data.

    Raises ValueError for a file that is not such a checkpoint.
    """
    try:
        state = torch.load(path, weights_only=True)
        model.set_parameters(state["parameters"])
        for name, value in state["variables"].items():
            with torch.no_grad():
                getattr(model, name).copy_(value)
        model.num_timesteps, model._n_updates = state["num_timesteps"], state["updates"]
        for name in BUFFER if state["buffer"] else ():
            stored = state["buffer"][name].numpy()
            getattr(model.replay_buffer, name)[: len(stored)] = stored
        if state["buffer"]:
            model.replay_buffer.pos, model.replay_buffer.full = state["buffer"]["pos"], state["buffer"]["full"]
        return dict(state["further"])
    except Exception as error:  # whatever PyTorch meets in a file that is something else
        raise ValueError(f"`out` must hold a checkpoint of the same training, got {path} ({error}).") from error


def _buffer(model: Any) -> dict[str, Any]:
    """What the replay buffer holds; nothing for an algorithm without one."""
    buffer = getattr(model, "replay_buffer", None)
    if buffer is None:
        return {}
    stop = buffer.buffer_size if buffer.full else buffer.pos
    arrays = {name: torch.from_numpy(np.ascontiguousarray(getattr(buffer, name)[:stop])) for name in BUFFER}
    return arrays | {"pos": buffer.pos, "full": buffer.full}
