"""PPO's experience collected in NumPy is the one that Stable-Baselines3 collects."""

from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
stable_baselines3 = pytest.importorskip("stable_baselines3")

from stable_baselines3.common.callbacks import BaseCallback  # noqa: E402

from baselines import agents, collection  # noqa: E402

ID = "mfc_gym/PerturbedChain-v0"
FIELDS = ("observations", "actions", "rewards", "episode_starts", "values", "log_probs", "advantages", "returns")
POLICIES: dict[str, dict[str, Any]] = {
    "64x64 tanh": {},
    "relu, actor and critic of their own": {"activation_fn": torch.nn.ReLU, "net_arch": {"pi": [16], "vf": [32, 8]}},
    "linear": {"net_arch": []},
}


def collected(kind: Any, policy: dict[str, Any], steps: int = 48, num_envs: int = 8) -> Any:
    """A model after two rollouts in which episodes end on the clock (every 16 steps) and outside the region."""
    envs = agents.make_vec_env(ID, num_envs, scenario="random", dt=0.05, horizon=0.8, input_limit=400.0)
    options = {"n_steps": steps, "batch_size": 64, "seed": 3, "device": "cpu", "policy_kwargs": policy}
    model = kind("MlpPolicy", envs, **options)
    _, callback = model._setup_learn(10**6)
    for _ in range(2):
        assert model.collect_rollouts(envs, callback, model.rollout_buffer, n_rollout_steps=steps)
    return model


@pytest.mark.parametrize("policy", POLICIES.values(), ids=POLICIES)
def test_equals_stable_baselines3(policy: dict[str, Any]) -> None:
    """Same seed, same random numbers: every field to the rounding of float32, which the plant amplifies over an episode."""
    own, theirs = (collected(kind, policy) for kind in (collection.PPO, stable_baselines3.PPO))
    assert collection.perceptrons(own.policy) is not None
    one, other = own.rollout_buffer, theirs.rollout_buffer
    starts = one.episode_starts[1:].astype(bool)
    assert starts.any(axis=0).all()
    assert (starts.sum(axis=0) > 3).any()  # some left the region
    for name in FIELDS:
        a, b = getattr(one, name), getattr(other, name)
        assert a.dtype == b.dtype
        assert np.abs(a - b).max() <= 1e-5 * max(1.0, np.abs(b).max()), name
    assert (one.pos, one.full, own.num_timesteps) == (other.pos, other.full, theirs.num_timesteps)
    assert np.allclose(own._last_obs, theirs._last_obs, rtol=1e-5, atol=1e-5)
    assert np.array_equal(own._last_episode_starts, theirs._last_episode_starts)
    assert list(own.ep_success_buffer) == list(theirs.ep_success_buffer)


def test_the_same_seed_gives_the_same_numbers() -> None:
    one, other = (collected(collection.PPO, {}).rollout_buffer for _ in range(2))
    assert all(np.array_equal(getattr(one, name), getattr(other, name)) for name in FIELDS)


@pytest.mark.parametrize(
    "options",
    [{"policy_kwargs": {"activation_fn": torch.nn.ELU}}, {"use_sde": True}],
    ids=["another activation", "state-dependent exploration"],
)
def test_other_policies_collect_as_stable_baselines3_does(options: dict[str, Any]) -> None:
    """To the last bit, for it is its own loop."""
    buffers = []
    for kind in (collection.PPO, stable_baselines3.PPO):
        envs = agents.make_vec_env(ID, 4, dt=0.05, horizon=0.5)
        model = kind("MlpPolicy", envs, n_steps=16, batch_size=64, seed=0, device="cpu", **options)
        model.learn(64)
        buffers.append(model.rollout_buffer)
    assert all(np.array_equal(getattr(buffers[0], name), getattr(buffers[1], name)) for name in FIELDS)


class Stop(BaseCallback):
    """Ends the collection at once, and looks at what it is shown."""

    def _on_step(self) -> bool:
        return not {"infos", "dones", "rewards", "new_obs", "actions", "clipped_actions", "env"} <= set(self.locals)


def test_a_callback_sees_the_step_and_may_stop_it() -> None:
    envs = agents.make_vec_env(ID, 4, dt=0.05, horizon=0.5)
    model = collection.PPO("MlpPolicy", envs, n_steps=16, batch_size=64, seed=0, device="cpu")
    model.learn(64, Stop())
    assert model.num_timesteps == 4
