"""Runs inside rejax's virtual environment: trains its PPO, unmodified, on our tasks.

Reads one JSON request from standard input, `{"tasks": [...], "seed": 0, "share": 1}`,
and writes one JSON line a task: versions, returns along the way, seconds.
"""

import json
import sys
import time
from importlib.metadata import version
from typing import Any

import jax
import numpy as np
from rejax import PPO  # pyright: ignore[reportMissingImports]

import delucax as dlx
from delucax.interop.gymnax import to_gymnax


# rejax's own settings for these tasks, and more steps for the pendulum.
SETTINGS: dict[str, dict[str, Any]] = {
    "pendulum": dict(
        agent_kwargs={"activation": "swish"},
        num_envs=100,
        num_steps=100,
        num_epochs=10,
        num_minibatches=10,
        learning_rate=0.001,
        max_grad_norm=10,
        total_timesteps=960_000,
        gamma=0.995,
        gae_lambda=0.95,
        clip_eps=0.2,
        ent_coef=0.0,
        vf_coef=0.5,
        normalize_observations=True,
    ),
    "cartpole": dict(
        agent_kwargs={"activation": "tanh"},
        num_envs=5,
        num_steps=100,
        num_epochs=5,
        num_minibatches=5,
        learning_rate=0.00075,
        max_grad_norm=0.5,
        total_timesteps=100_000,
        gamma=0.99,
        gae_lambda=0.95,
        clip_eps=0.2,
        ent_coef=0.01,
        vf_coef=0.5,
    ),
}


def train(task: str, seed: int, share: float) -> dict[str, Any]:
    """Train on a task, and say how it went."""
    settings = dict(SETTINGS[task])
    settings["agent_kwargs"] = dict(settings["agent_kwargs"])
    steps = int(settings["total_timesteps"] * share)
    settings |= dict(total_timesteps=steps, eval_freq=max(1, steps // 8))
    algorithm = PPO.create(env=to_gymnax(dlx.make(task)), **settings)
    start = time.perf_counter()
    train_compiled = jax.jit(algorithm.train).lower(jax.random.key(seed)).compile()
    middle = time.perf_counter()
    state, (lengths, returns) = jax.block_until_ready(
        train_compiled(jax.random.key(seed))
    )
    end = time.perf_counter()
    returns = np.asarray(returns)
    return {
        "task": task,
        "steps": int(state.global_step),
        "episodes": returns.shape[1],
        "returns": returns.mean(axis=1).round(2).tolist(),
        "deviations": returns.std(axis=1).round(2).tolist(),
        "lengths": np.asarray(lengths).mean(axis=1).round(1).tolist(),
        "compile_seconds": round(middle - start, 2),
        "seconds": round(end - middle, 2),
        "versions": {name: version(name) for name in ("rejax", "gymnax", "jax")},
    }


def main() -> None:
    """Answer the request."""
    request = json.loads(sys.stdin.readline())
    for task in request["tasks"]:
        answer = train(task, request["seed"], request["share"])
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
