"""How fast: each function measures one thing beside its yardstick in the same run and gives rows (what, value, unit, ratio)."""

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv
from scipy.integrate import solve_ivp

from baselines import lyapunov, registry, rollout_kernel
from baselines.filippov import filippov
from baselines.redesign import LyapunovRedesign
from baselines.redesign_kernel import Layout

Row = tuple[str, float, str, float | None]  # what, value, unit, ratio to the yardstick (None: it is the yardstick)
ID = "mfc_gym/PerturbedChain-v0"
REPEATS = 5
SOURCE = Path(__file__).parents[1] / "scripts" / "closed_loop.c"


def median_rate(work: Callable[[], int], seconds: float = 0.4) -> float:
    """Median over REPEATS of what `work` does per second; it returns how much it did."""
    work()
    rates = []
    for _ in range(REPEATS):
        done, begin = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - begin) < seconds:
            done += work()
        rates.append(done / elapsed)
    return statistics.median(rates)


def single() -> list[Row]:
    """Steps per second of one environment from `gym.make`, resets included."""

    def steps(env: gym.Env[Any, Any], count: int = 2000) -> Callable[[], int]:
        actions = [env.action_space.sample() for _ in range(16)] * (count // 16)
        env.reset(seed=0)

        def work() -> int:
            for action in actions:
                _, _, terminated, truncated, _ = env.step(action)
                if terminated or truncated:
                    env.reset()
            return len(actions)

        return work

    yardstick = median_rate(steps(gym.make("CartPole-v1")))
    rows: list[Row] = [("CartPole-v1", yardstick, "steps/s", None)]
    others = {
        "Pendulum-v1": gym.make("Pendulum-v1"),
        "PerturbedChain-v0": gym.make(ID),
        "PerturbedChain-v0, 10 substeps": gym.make(ID, substeps=10),
    }
    for name, env in others.items():
        rate = median_rate(steps(env))
        rows.append((name, rate, "steps/s", rate / yardstick))
    return rows


def vector(num_envs: int = 16384) -> list[Row]:
    """Environment steps per second of the native vector environment."""

    def steps(envs: Any) -> Callable[[], int]:
        actions = envs.action_space.sample()
        envs.reset(seed=0)

        def work() -> int:
            for _ in range(5):
                envs.step(actions)
            return 5 * int(envs.num_envs)

        return work

    native: dict[str, Any] = {"vectorization_mode": "vector_entry_point"}
    yardstick = median_rate(steps(gym.make_vec("CartPole-v1", num_envs=num_envs, **native)))
    rows: list[Row] = [(f"CartPoleVectorEnv, {num_envs}", yardstick, "steps/s", None)]
    for substeps, name in ((1, "1 substep"), (10, "10 substeps")):
        for threads, where in ((None, ""), (1, ", 1 thread"), (2, ", 2 threads")):
            envs = gym.make_vec(ID, num_envs=num_envs, substeps=substeps, threads=threads, **native)
            rate = median_rate(steps(envs))
            rows.append((f"PerturbedChain, {num_envs}, {name}{where}", rate, "steps/s", rate / yardstick))
    rate = median_rate(steps(SyncVectorEnv([lambda: gym.make(ID)] * 64)))
    rows.append(("SyncVectorEnv, 64", rate, "steps/s", rate / yardstick))
    return rows


def mfc(env: gym.Env[Any, Any], **options: Any) -> LyapunovRedesign:
    """The reference policy with these options."""
    controller = registry.make("mfc", env, **options)
    assert isinstance(controller, LyapunovRedesign)
    return controller


@contextmanager
def one_core() -> Iterator[None]:
    """This process on one core."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def rollouts(episodes: int = 1000) -> list[Row]:
    """Time per control step of whole compiled episodes on one core, beside the same closed loop written in C."""
    env = gym.make(ID, scenario="paper")
    plain: Any = env.unwrapped
    simulation, controller = plain.simulation, mfc(env)
    run = rollout_kernel.load(simulation.kernel, controller).run
    first, _ = env.reset(seed=0)
    observations = np.empty((episodes, simulation.steps + 1, first.size))
    observations[:, 0] = first
    outputs, controls = np.empty(observations.shape[:2]), np.empty((episodes, simulation.steps))
    rewards, terminated = np.empty_like(controls), np.empty(episodes, dtype=bool)
    table = simulation.table(plain.rows)

    def work() -> int:
        rows = np.repeat(plain.rows, episodes, axis=0)
        memory = controller.first_memory(observations[:, 0])
        run(
            rows,
            simulation.settings,
            memory,
            controller.law,
            table,
            observations,
            outputs,
            controls,
            rewards,
            terminated,
            0,
            episodes,
        )
        return controls.size

    with one_core():
        rate = median_rate(work, seconds=0.1)
        yardstick = c_loop(controller, simulation)
    value = 1e9 / rate
    rows: list[Row] = []
    if yardstick is not None:
        rows.append(("closed loop in C (-O3), nothing recorded", yardstick[0], "ns/step", None))
        if abs(yardstick[1] - outputs[0, -1]) > 1e-9:
            raise RuntimeError(f"the C loop ends at y = {yardstick[1]}, the compiled rollout at {outputs[0, -1]}.")
    ratio = value / yardstick[0] if yardstick else None
    return [*rows, (f"baselines.rollout, {simulation.substeps} substeps, all recorded", value, "ns/step", ratio)]


def c_loop(controller: Any, simulation: Any) -> tuple[float, float] | None:
    """(ns per control step, y at the end) of scripts/closed_loop.c, compiled here; None without a C compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return None
    layout, law = Layout(3), controller.law
    vectors = [law[layout.vector(v) : layout.vector(v) + 3] for v in ("k", "k_tilde", "c", "cE", "cPhi")]
    numbers = [
        simulation.dt, simulation.steps, simulation.substeps, 200, *np.concatenate(vectors), law[layout.scalar("b")],
        *law[layout.E : layout.E + 9], 0.25, controller.margin, simulation.input_limit,
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        program = str(Path(folder) / "closed_loop")
        subprocess.run([compiler, "-O3", "-march=native", "-o", program, str(SOURCE), "-lm"], check=True)
        command = [program, *(repr(float(v)) for v in numbers)]
        runs = [
            subprocess.run(command, capture_output=True, text=True, check=True).stdout.split() for _ in range(REPEATS)
        ]
    return statistics.median(float(r[0]) for r in runs), float(runs[0][1])


def exact() -> list[Row]:
    """The event-driven solution beside solve_ivp (RK45, its defaults) on the paper's law with the plain sgn."""
    env = gym.make(ID)
    controller = mfc(env, design="paper", gain="paper", initial_model_state=(0.5, 0.0, 0.0))
    c, k, k_tilde = lyapunov.surface(controller.P), controller.k, controller.k_tilde

    def rhs(t: float, q: np.ndarray) -> np.ndarray:
        x, xi_star = q[:3], q[3:]
        e = np.array([x[0], 1.5 * x[1], 0.75 * x[2]]) - xi_star
        omega = -np.cos(t) - k @ (xi_star - [np.sin(t), np.cos(t), -np.sin(t)])
        v, delta = -k_tilde @ e, x @ x
        Gamma = (1.25 * delta + 0.25 * (abs(omega) + abs(v))) / 0.75
        u = omega + v - Gamma * np.sign(c @ e)
        return np.array([1.5 * x[1], 0.5 * x[2], u + delta, xi_star[1], xi_star[2], omega])

    def seconds(work: Callable[[], Any]) -> float:
        work()
        begin = time.perf_counter()
        work()
        return time.perf_counter() - begin

    yardstick = seconds(lambda: solve_ivp(rhs, (0, 20), [1, 0, 0, 0.5, 0, 0]))
    value = seconds(lambda: filippov(env, controller))
    return [
        ("solve_ivp on the plain sgn, error 2e-2", yardstick, "s", None),
        ("baselines.filippov, error 1e-10", value, "s", value / yardstick),
    ]


def cold_start() -> list[Row]:
    """A fresh process: import, make, reset, one step; the kernels' cache warm and cold."""
    body = "import gymnasium as gym{}; env = gym.make('{}'); env.reset(seed=0); env.step(env.action_space.sample())"

    def seconds(code: str, **variables: str) -> float:
        times = []
        for _ in range(3 if not variables else 1):
            begin = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | variables)
            times.append(time.perf_counter() - begin)
        return statistics.median(times)

    yardstick = seconds(body.format("", "CartPole-v1"))
    own = body.format(", mfc_gym", ID)
    warm = seconds(own)
    with tempfile.TemporaryDirectory() as folder:
        cold = seconds(own, MFC_GYM_CACHE=folder)
    return [
        ("CartPole-v1", yardstick, "s", None),
        ("PerturbedChain-v0, warm cache", warm, "s", warm / yardstick),
        ("PerturbedChain-v0, cold cache", cold, "s", cold / yardstick),
    ]


def memory() -> list[Row]:
    """Resident memory per environment beyond the first, in fresh processes, after one step."""
    code = (
        "import resource, gymnasium as gym, mfc_gym, numpy as np\n"
        "from pathlib import Path\n"
        f"envs = gym.make_vec('{ID}', num_envs={{}}, vectorization_mode='vector_entry_point')\n"
        "envs.reset(seed=0)\nenvs.step(np.zeros(({}, 1)))\n"
        "print(int(Path('/proc/self/statm').read_text().split()[1]) * resource.getpagesize() / 1024)"
    )

    def kilobytes(n: int) -> float:
        run = subprocess.run([sys.executable, "-c", code.format(n, n)], capture_output=True, text=True, check=True)
        return float(run.stdout)

    kilobytes(1)  # compiles, if need be
    base = kilobytes(1)
    more = [(n, max(kilobytes(n) - base, 0.0) * 1024 / n) for n in (1024, 65536)]
    return [
        ("1 environment, the whole process", base / 1024, "MB", None),
        *((f"each of {n} more", value, "bytes", None) for n, value in more),
    ]


def experience(num_envs: int = 64) -> list[Row]:
    """Experience for PPO with a 64x64 policy: Stable-Baselines3 over DummyVecEnv, over the adapter, and what `train_rl` uses."""
    from baselines import agents, collection  # first: they say which extra is missing

    # isort: split
    import stable_baselines3
    import torch
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.vec_env import VecEnv

    threads = torch.get_num_threads()
    torch.set_num_threads(1)

    def collect(algorithm: Any, envs: VecEnv) -> Callable[[], int]:
        model = algorithm("MlpPolicy", envs, n_steps=64, batch_size=64, seed=0, device="cpu")
        model.set_logger(Logger(folder=None, output_formats=[]))
        _, callback = model._setup_learn(10**9)

        def work() -> int:
            model.collect_rollouts(envs, callback, model.rollout_buffer, n_rollout_steps=64)
            return 64 * num_envs

        return work

    yardstick = median_rate(collect(stable_baselines3.PPO, make_vec_env(ID, num_envs)))
    rows: list[Row] = [(f"SB3 PPO, DummyVecEnv, {num_envs}", yardstick, "steps/s", None)]
    for algorithm, name in ((stable_baselines3.PPO, "SB3 PPO"), (collection.PPO, "collection.PPO")):
        rate = median_rate(collect(algorithm, agents.make_vec_env(ID, num_envs)))
        rows.append((f"{name}, agents.make_vec_env, {num_envs}", rate, "steps/s", rate / yardstick))
    torch.set_num_threads(threads)
    return rows


MEASUREMENTS: dict[str, Callable[[], list[Row]]] = {
    "single": single,
    "vector": vector,
    "rollout": rollouts,
    "exact": exact,
    "start": cold_start,
    "memory": memory,
    "sb3": experience,
}
