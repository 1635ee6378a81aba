"""PPO and SAC of Stable-Baselines3: the part `rivals` of `benchmarks.policies`.

Both sides control the same plant at the same cost. Theirs is stepped by compiled C, and
is given 20 times the budget of `training.synthesise`, which holds all its compilation.
Ours is in seconds of the clock and theirs of the processor, so that a busy machine
costs them nothing; evaluations are not counted. Their best policy on starts of a
validation is kept, checked 20 times on the way. The settings are those
that the authors publish for Gym's version of the task (rl-baselines3-zoo,
`hyperparams/`), or the defaults where there are none. Gym's cart-pole has two actions
and a reward of one a step; ours has a force, and costs in the thousands. So there both
are trained a second time with `VecNormalize` around the same settings, for observations
and rewards; an evaluation has the observations by the same statistics, frozen, and the
cost as it is. The networks are small, so that each training has one thread.

All are compared on the same starts, which none was trained or chosen on. Between the
seeds of two methods there are no pairs. So beside the mean difference stands its range
over all pairs of a seed of ours and one of theirs: ours is better if each of our seeds
is better than each of theirs. Of three seeds a bootstrap would be no interval of 95%.
"""

import copy
import time
from typing import Any

import jax
import jax.random as jr
import numpy as np
import pandas as pd

import delucax as dlx
from benchmarks import _cases
from benchmarks._family import cartpole


STORE = _cases.RESULTS / "rivals.jsonl"
SEEDS, BUDGET, TIMES = 3, 30.0, 20
STARTS, VALIDATION, CHECKS = 32, 16, 20
TASKS = ("pendulum", "acrobot", "cart-pole")
OURS, LQR = "synthesise", "LQR"
PPO_OF_PENDULUM: dict[str, Any] = dict(
    n_steps=1024,
    gae_lambda=0.95,
    gamma=0.9,
    n_epochs=10,
    ent_coef=0.0,
    learning_rate=1e-3,
    clip_range=0.2,
    use_sde=True,
    sde_sample_freq=4,
)
# Published for Pendulum-v1, Acrobot-v1 and CartPole-v1. `envs` and `normalised` are
# those of the training; a rate or a range that is `falling` ends at zero.
PUBLISHED: dict[tuple[str, str], dict[str, Any]] = {
    ("pendulum", "PPO"): dict(envs=4, **PPO_OF_PENDULUM),
    ("pendulum", "SAC"): dict(learning_rate=1e-3),
    ("acrobot", "PPO"): dict(
        envs=16,
        normalised=True,
        n_steps=256,
        gae_lambda=0.94,
        gamma=0.99,
        n_epochs=4,
        ent_coef=0.0,
    ),
    ("cart-pole", "PPO"): dict(
        envs=8,
        n_steps=32,
        batch_size=256,
        gae_lambda=0.8,
        gamma=0.98,
        n_epochs=20,
        ent_coef=0.0,
        learning_rate=1e-3,
        clip_range=0.2,
        falling=("learning_rate", "clip_range"),
    ),
}
NORMALISED = ("cart-pole",)
"""The tasks on which `VecNormalize` is tried around the same settings, too."""


def task_of(name: str) -> dlx.Environment:
    """The plant and the cost; the cart-pole is the nominal one of the family."""
    return cartpole() if name == "cart-pole" else dlx.make(name)


def drawn(env: Any, seed: int, count: int) -> np.ndarray:
    """Starts."""
    return np.asarray(jax.vmap(env.reset)(jr.split(jr.key(seed), count)))


def case(task: str, method: str, seed: int, seconds: float = 0.0) -> dict[str, Any]:
    """What one policy costs from each start, in this process."""
    env = task_of(task)
    if method not in (OURS, LQR):
        return theirs(env, task, method, seed, seconds)
    began = time.perf_counter()
    if method == LQR:
        structure, policy = LQR, dlx.controllers.local_lqr(env)
    else:
        how: Any = dict(key=jr.key(seed), budget=BUDGET, progress=False)
        made = dlx.training.synthesise(env, **how)
        structure, policy = made.structure, made.policy
    taken = time.perf_counter() - began
    quiet: Any = dict(key=jr.key(0), keep=(), throw=False)
    run = lambda x0: dlx.rollout(env, policy, x0=x0, **quiet).total_cost
    costs = [float(run(x0)) for x0 in drawn(env, 2**20, STARTS)]
    return {"structure": structure, "taken": taken, "costs": costs}


def theirs(
    env: Any, task: str, method: str, seed: int, seconds: float
) -> dict[str, Any]:
    """PPO or SAC, for so many seconds."""
    import stable_baselines3  # pyright: ignore
    import torch  # pyright: ignore
    from gymnasium.wrappers import RescaleAction
    from stable_baselines3.common.callbacks import BaseCallback  # pyright: ignore
    from stable_baselines3.common.vec_env import (  # pyright: ignore
        DummyVecEnv,
        VecNormalize,
    )

    from delucax.interop.gymnasium import GymnasiumEnv

    torch.set_num_threads(1)
    algorithm, setting = method.split(", ")
    given = dict(PUBLISHED.get((task, algorithm), {}))
    count = given.pop("envs", 1)
    normalised = given.pop("normalised", setting == "normalised")

    def one():
        plant = GymnasiumEnv(env, discrete=False, backend="c")
        # A first deviation of 1 has to mean something.
        return RescaleAction(plant, np.float32(-1), np.float32(1))

    venv: Any = DummyVecEnv([one] * count)
    if normalised:
        venv = VecNormalize(venv, gamma=given.get("gamma", 0.99))

    class Clock(BaseCallback):
        """Stops in time, and keeps the best policy."""

        began = paused = 0.0
        best, checked = (np.inf, {}, None), 0

        @property
        def share(self) -> float:
            """The part of the time that is over."""
            return (time.process_time() - self.began - self.paused) / seconds

        def _on_training_start(self):
            self.began = time.process_time()

        def _on_step(self):
            if self.share >= (self.checked + 1) / CHECKS:
                self.check()
            return self.share < 1

        def check(self):
            at, self.checked = time.process_time(), self.checked + 1
            cost = float(np.mean(costs_of(self.model, venv, one, held_out)))
            if cost < self.best[0]:
                state = copy.deepcopy(self.model.policy.state_dict())
                self.best = cost, state, copy.deepcopy(getattr(venv, "obs_rms", None))
            self.paused += time.process_time() - at

    held_out, clock = drawn(env, 2**21, VALIDATION), Clock()
    for name in given.pop("falling", ()):
        first = given[name]
        given[name] = lambda _, first=first: first * max(0.0, 1 - clock.share)
    kind = getattr(stable_baselines3, algorithm)
    model = kind("MlpPolicy", venv, seed=seed, device="cpu", **given)
    model.learn(10**9, callback=clock)
    steps = model.num_timesteps
    if clock.best[1]:
        model.policy.load_state_dict(clock.best[1])
        if normalised:
            venv.obs_rms = clock.best[2]
    costs = costs_of(model, venv, one, drawn(env, 2**20, STARTS)).tolist()
    return {"steps": steps, "taken": seconds, "costs": costs}


def costs_of(model: Any, venv: Any, one: Any, starts: np.ndarray) -> np.ndarray:
    """The cost of an episode from each start, all stepped together."""
    plants = [one() for _ in starts]
    observations = np.stack(
        [
            plant.reset(seed=0, options={"state": x0})[0]
            for plant, x0 in zip(plants, starts, strict=True)
        ]
    )
    costs, active = np.zeros(len(starts)), np.ones(len(starts), bool)
    shown = getattr(venv, "normalize_obs", lambda y: y)
    while np.any(active):
        actions, _ = model.predict(shown(observations), deterministic=True)
        for k in np.flatnonzero(active):
            y, reward, terminated, truncated, _ = plants[k].step(actions[k])
            observations[k] = y
            costs[k] -= float(reward)
            active[k] = not (terminated or truncated)
    return costs


def methods(task: str) -> list[str]:
    """The rivals of a task."""
    both = "PPO", "SAC"
    known = {a: "published" if (task, a) in PUBLISHED else "defaults" for a in both}
    made = [f"{algorithm}, {known[algorithm]}" for algorithm in both]
    if task in NORMALISED:
        made += [f"{algorithm}, normalised" for algorithm in both]
    return made


def rivals(only: list[str], seeds: int = SEEDS, **how: Any) -> dict[str, Any]:
    """Run what is missing, and print what all reach."""
    names = only or list(TASKS)
    cases = [
        {"task": task, "method": OURS, "seed": seed}
        for seed in range(seeds)
        for task in names
    ]
    laws = [{"task": task, "method": LQR, "seed": 0} for task in names]
    said = lambda row: f"costs {np.mean(row['costs']):.4g}, {row['taken']:.0f} s"
    own = _cases.run("benchmarks._rivals", STORE, cases + laws, said, **how)
    cases = [
        {
            "task": row["task"],
            "method": method,
            "seed": row["seed"],
            "seconds": TIMES * BUDGET,
        }
        for row in cases
        for method in methods(row["task"])
    ]
    rows = own + _cases.run("benchmarks._rivals", STORE, cases, said, **how)
    made = []
    for task in names:
        ours = costs(rows, task, OURS)
        for method in (LQR, OURS, *methods(task)):
            other = costs(rows, task, method)
            # A setting that was tried with fewer seeds says so.
            if len(ours) == seeds and len(other):
                about = {"task": task, "method": method, "seeds": len(other)}
                made.append(about | beside(ours, other))
    table = pd.DataFrame(made)
    print(table.to_string(index=False, float_format="%.4g"))
    if len(table):
        judge(table[~table["method"].isin([LQR, OURS])])
    missing = len(cases) + seeds * len(names) + len(laws) - len(rows)
    if missing:
        print(f"{missing} trainings failed, and their methods are left out")
    return {"seeds": seeds, "times": TIMES, "rows": table.to_dict("records")}


def costs(rows: list[dict[str, Any]], task: str, method: str) -> np.ndarray:
    """A row for each seed, a column for each start."""
    which = [row for row in rows if (row["task"], row["method"]) == (task, method)]
    return np.array(
        [row["costs"] for row in sorted(which, key=lambda row: row["seed"])]
    )


def beside(ours: np.ndarray, other: np.ndarray) -> dict[str, float]:
    """The cost of a method; the range of its seeds; and how much less ours is, with the
    range over all pairs of a seed of ours and one of theirs."""
    own, theirs = np.mean(ours, axis=1), np.mean(other, axis=1)
    return {
        "cost": np.mean(theirs),
        "best seed": np.min(theirs),
        "worst seed": np.max(theirs),
        "ours less theirs": np.mean(own) - np.mean(theirs),
        "low": np.min(own) - np.max(theirs),
        "high": np.max(own) - np.min(theirs),
    }


def judge(table: Any) -> None:
    """Print where ours is better, and where it is not."""
    better = table["high"] < 0
    for _, row in table[~better].iterrows():
        how = "is worse than" if row["low"] > 0 else "is not told from"
        print(f"{row['task']}: {OURS} {how} {row['method']}")
    met = "met" if np.all(better) else "NOT met"
    print(f"better than {np.sum(better)} of {len(table)}: {met}")


if __name__ == "__main__":
    _cases.answer(case)
