"""`python -m benchmarks.stable_baselines3`: Stable-Baselines3 trains on our pendulum.

Its PPO, on the CPU, sees `delucax/Pendulum-v1` as it sees any Gymnasium id. The policy
is then tried on Gymnasium's own `Pendulum-v1` too. With `--vector` it trains on
`SB3VecEnv`. Prints the mean returns before and after, and writes
`benchmarks/results/stable_baselines3.json`. Needs the group `sb3`:
`pip install -e ".[gymnasium]" --group bench --group sb3`.
"""

import argparse
import json
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium

import delucax
import delucax.interop.gymnasium  # noqa: F401, tells Gymnasium of our tasks
from benchmarks._machine import compile_anew, describe, limit_cores
from benchmarks._rivals import PPO_OF_PENDULUM


OUT = Path(__file__).parent / "results" / "stable_baselines3.json"
OURS, THEIRS = "delucax/Pendulum-v1", "Pendulum-v1"


def evaluated(model: Any, id: str, episodes: int) -> dict[str, float]:
    """The mean and the standard deviation of the return."""
    from stable_baselines3.common.evaluation import (  # pyright: ignore
        evaluate_policy,
    )
    from stable_baselines3.common.monitor import Monitor  # pyright: ignore

    env = Monitor(gymnasium.make(id))
    env.reset(seed=1000)
    mean, deviation = evaluate_policy(model, env, n_eval_episodes=episodes)
    return {"mean": round(float(mean), 1), "deviation": round(float(deviation), 1)}


def main() -> None:
    """Train, print and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.stable_baselines3")
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--episodes", type=int, default=100, help="of an evaluation")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default=str(OUT))
    parser.add_argument("--cores", type=int, default=1)
    parser.add_argument(
        "--vector", action="store_true", help="step all in one call, as `SB3VecEnv`"
    )
    options = parser.parse_args()
    limit_cores(options.cores)
    compile_anew()
    import torch  # pyright: ignore
    from stable_baselines3 import PPO  # pyright: ignore
    from stable_baselines3.common.env_checker import check_env  # pyright: ignore
    from stable_baselines3.common.env_util import make_vec_env  # pyright: ignore
    from stable_baselines3.common.vec_env import VecMonitor  # pyright: ignore

    from delucax.interop.stable_baselines3 import SB3VecEnv

    torch.set_num_threads(options.cores)
    check_env(gymnasium.make(OURS).unwrapped)
    if options.vector:
        envs = VecMonitor(SB3VecEnv(delucax.make("pendulum"), 4))
        envs.seed(options.seed)
    else:
        envs = make_vec_env(OURS, n_envs=4, seed=options.seed)
    model = PPO("MlpPolicy", envs, seed=options.seed, device="cpu", **PPO_OF_PENDULUM)
    before = evaluated(model, OURS, options.episodes)
    print(f"before: {before['mean']} +- {before['deviation']}", flush=True)
    start = time.perf_counter()
    model.learn(options.steps)
    seconds = time.perf_counter() - start
    after = {id: evaluated(model, id, options.episodes) for id in (OURS, THEIRS)}
    print(f"{model.num_timesteps:,} steps in {seconds:.0f} s")
    for id, result in after.items():
        print(f"after, on {id}: {result['mean']} +- {result['deviation']}")
    packages = ("stable-baselines3", "torch", "gymnasium")
    content = {
        "machine": describe(),
        "versions": {name: version(name) for name in packages},
        "settings": PPO_OF_PENDULUM,
        "vector": options.vector,
        "seed": options.seed,
        "steps": model.num_timesteps,
        "seconds": round(seconds, 1),
        "episodes": options.episodes,
        "before": before,
        "after": after,
    }
    out = Path(options.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(content, indent=1) + "\n")
    print(f"written: {out}")


if __name__ == "__main__":
    main()
