"""`python -m benchmarks.policies`: gradients through the simulator beside the others.

Four parts, each written to `benchmarks/results/policies.json` when it is done:

- `figure`: the paper's first figure, right: a linear policy of the pendulum by the
  gradient of the rollout and by Gaussian evolution strategies;
- `variance`: of the estimators against the number of parameters, at equal calls of the
  dynamics, and of the analytic one against the horizon;
- `swing-up`: PPO on ten seeds, with the steps and the seconds it takes;
- `learning`: PPO, SHAC and the analytic gradient at equal steps of the environment.

Settings were chosen on seeds that are not among those reported.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pandas as pd

import delucax as dlx
from benchmarks._machine import describe, limit_cores
from delucax.experiments import holds_upright
from delucax.training import (
    actor_critic,
    analytic,
    EvolutionStrategies,
    expected_cost,
    fit,
    LikelihoodRatio,
    PPO,
    scored_cost,
    SHAC,
)


RESULTS = Path(__file__).parent / "results" / "policies.json"
PARTS = ("figure", "variance", "swing-up", "learning")
FIRST_SEED = 1000
CORNER = np.array([np.pi, 8.0])
SPREAD = {"initial_state.low": -CORNER, "initial_state.high": CORNER}


def shown(rows: list[dict[str, Any]], title: str) -> list[dict[str, Any]]:
    """Print a table, and give it back."""
    print(f"\n{title}")
    table = pd.DataFrame(rows)
    print(table.to_string(index=False, float_format="%.4g", na_rep=""), flush=True)
    return rows


def figure(small: bool) -> dict[str, Any]:
    """Rollouts until the mean cost of the pendulum is at most 2.0."""
    env = dlx.make("pendulum", max_torque=10.0, initial_state=np.array([np.pi, 0.0]))
    total = expected_cost(env, batch=1, horizon=50)
    policy = dlx.controllers.Linear(jnp.zeros((1, 2)))
    # Plain descent with the paper's step reaches 2.0 later; the step is the same for
    # all, and the gradient alone is shown at the paper's own too.
    optimiser = optax.sgd(0.02)

    def loss(controller, key):
        return total(controller, key) / 50

    steps = 200 if small else 1500
    options: Any = dict(progress=False, throw=False, block=500)
    own = fit(loss, policy, optimiser, steps, key=jr.key(0), **options)
    costs = own.history.loss
    first = int(np.argmax(costs <= 2.0)) if np.any(costs <= 2.0) else None
    rows = [
        {
            "estimator": "analytic",
            "rollouts to 2.0, median": first,
            "seeds that get there": "1 of 1" if first is not None else "0 of 1",
            "best cost": float(np.min(costs)),
        }
    ]
    slow = fit(loss, policy, optax.sgd(0.01), steps, key=jr.key(0), **options)
    below = np.flatnonzero(slow.history.loss <= 2.0)
    rows.append(
        {
            "estimator": "analytic, half the step",
            "rollouts to 2.0, median": int(below[0]) if len(below) else None,
            "seeds that get there": f"{int(len(below) > 0)} of 1",
            "best cost": float(np.min(slow.history.loss)),
        }
    )
    seeds = 5
    keys = jr.split(jr.key(FIRST_SEED), seeds)
    models = eqx.filter_vmap(lambda _: policy, axis_size=seeds)(keys)
    curves = {"analytic": costs.tolist()}
    scales = (0.1,) if small else (0.05, 0.1, 0.3)
    pairs = (4,) if small else (1, 4, 16, 64)
    for sigma in scales:
        for n in pairs:
            estimator = EvolutionStrategies(sigma=sigma, samples=2 * n)
            found = fit(
                loss,
                models,
                optimiser,
                steps,
                key=keys,
                gradient=estimator,
                **options,
            ).history.loss
            there = [np.argmax(c <= 2.0) for c in found.T if np.any(c <= 2.0)]
            rows.append(
                {
                    "estimator": f"ES, sigma {sigma}, {n} pairs",
                    "rollouts to 2.0, median": (
                        float(np.median(there)) * 2 * n if there else None
                    ),
                    "seeds that get there": f"{len(there)} of {seeds}",
                    "best cost": float(np.nanmin(found)),
                }
            )
            print(f"  {rows[-1]}", flush=True)
    shown(rows, f"Rollouts until the mean cost is 2.0, of {steps} iterations")
    return {"rows": rows, "analytic": curves["analytic"]}


def relative_variance(estimator, loss, model, truth, keys) -> float:
    """`E |g - E g|^2 / |truth|^2`, over keys."""
    draw = jax.jit(
        jax.vmap(
            lambda key: jax.flatten_util.ravel_pytree(estimator(loss, model, key)[1])[0]
        )
    )
    found = np.asarray(draw(keys))
    return float(np.sum(np.var(found, axis=0, ddof=1)) / np.sum(truth**2))


def flat(tree) -> np.ndarray:
    return np.asarray(jax.flatten_util.ravel_pytree(tree)[0])


def variance(small: bool) -> dict[str, Any]:
    """Linear feedback `n x n` of a random stable plant, 64 rollouts an estimate."""
    rollouts, draws, horizon = 64, 64 if small else 256, 20
    rows = []
    for n in (2, 4) if small else (1, 2, 4, 8, 16):
        key, start = jr.split(jr.key(FIRST_SEED + n))
        # A rotation that decays, and noise of a spectral norm that is the same for all
        # sizes: no draw comes near instability.
        A = 0.7 * np.linalg.qr(np.asarray(jr.normal(key, (n, n))))[0]
        std = 0.03 / np.sqrt(n)
        env = dlx.environments.lds(
            A,
            np.eye(n),
            initial_state=lambda key, n=n: jr.normal(key, (n,)) / np.sqrt(n),
            horizon=horizon,
        )
        base = dlx.controllers.Linear(jnp.zeros((n, n)))
        noisy = dlx.controllers.Gaussian(base, jnp.full(n, np.log(std)))
        many = expected_cost(env, batch=2**12)
        truth = flat(jax.jit(lambda m, k, f=many: analytic(f, m, k)[1])(base, start))
        one = expected_cost(env, batch=1)
        estimators = {
            "analytic": (analytic, expected_cost(env, batch=rollouts), base),
            "ES, antithetic": (EvolutionStrategies(std, rollouts), one, base),
            "ES, one-sided": (EvolutionStrategies(std, rollouts, False), one, base),
        }
        keys = jr.split(jr.key(FIRST_SEED), draws)
        row: dict[str, Any] = {"parameters": n * n}
        for name, (estimator, loss, model) in estimators.items():
            row[name] = relative_variance(estimator, loss, model, truth, keys)

        score = scored_cost(env)

        def scored(K, key, noisy=noisy, score=score):
            return score(eqx.tree_at(lambda m: m.base.K, noisy, K), key)

        for name, baseline in (("REINFORCE, baseline", True), ("REINFORCE", False)):
            estimator = LikelihoodRatio(rollouts, baseline)
            row[name] = relative_variance(estimator, scored, base.K, truth, keys)
        rows.append(row)
        print(f"  {row}", flush=True)
    shown(rows, f"Variance / |gradient|^2, {rollouts} rollouts an estimate")

    env = dlx.replace(dlx.make("pendulum"), SPREAD)
    policy = dlx.controllers.Deep(env, width=32, depth=1, key=jr.key(FIRST_SEED))
    noisy = dlx.controllers.Gaussian(policy, -1.0, bounds=env.control_bounds)
    over = []
    for horizon in (10, 50) if small else (10, 25, 50, 100, 200, 400):
        loss = expected_cost(env, batch=1, horizon=horizon)
        draw = jax.jit(
            jax.vmap(
                lambda key, loss=loss: jax.flatten_util.ravel_pytree(
                    analytic(loss, policy, key)[1]
                )[0]
            )
        )
        found = np.asarray(draw(jr.split(jr.key(FIRST_SEED), 512)))
        mean = np.mean(found, axis=0)
        norms = np.linalg.norm(found, axis=1)
        score = scored_cost(env, horizon=horizon)

        def scored(base, key, score=score):
            return score(eqx.tree_at(lambda m: m.base, noisy, base), key)

        keys = jr.split(jr.key(FIRST_SEED), 64)
        estimator = LikelihoodRatio(8)
        over.append(
            {
                "horizon": horizon,
                "|mean gradient|": float(np.linalg.norm(mean)),
                "median |gradient|": float(np.median(norms)),
                "largest |gradient|": float(np.max(norms)),
                "analytic, variance / |mean|^2": float(
                    np.sum(np.var(found, axis=0, ddof=1)) / np.sum(mean**2)
                ),
                "REINFORCE, 8 rollouts, variance": relative_variance(
                    estimator, scored, policy, np.ones(1), keys
                ),
                "analytic, 8 rollouts, variance": float(
                    np.sum(np.var(found, axis=0, ddof=1)) / 8
                ),
            }
        )
        print(f"  {over[-1]}", flush=True)
    shown(over, "The pendulum, an MLP: the gradient of the total cost")
    return {"parameters": rows, "horizon": over}


STARTS = 100


@eqx.filter_jit
def evaluated(env, policies) -> tuple[Any, Any]:
    """`(starts of 100 held upright, mean cost of 200 steps)` of each of a batch."""
    starts = jax.vmap(env.reset)(jr.split(jr.key(2**20), STARTS))

    def one(policy):
        options: Any = dict(key=jr.key(0), horizon=400, throw=False)
        run = jax.vmap(lambda x0: dlx.rollout(env, policy, x0=x0, **options))(starts)
        return jnp.sum(holds_upright(run)), jnp.mean(jnp.sum(run.costs[:, :200], 1))

    return eqx.filter_vmap(one)(policies)


def by_ppo(env, keys, steps, width=32, depth=1, rate=3e-3):
    """`(policies, steps of the environment that each seed took)`."""
    batch, horizon, epochs, minibatches = 32, 50, 10, 8
    rounds = max(1, round(steps / (batch * horizon)) - 1)
    ppo = PPO(
        dlx.replace(env, SPREAD),
        batch,
        horizon,
        discount=0.95,
        epochs=epochs,
        minibatches=minibatches,
    )
    count = rounds * epochs * minibatches
    schedule = optax.linear_schedule(rate, rate / 10, count)
    optimiser = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(schedule))
    make = lambda key: actor_critic(env, width, depth, key=key)
    models = eqx.filter_vmap(make)(keys)
    found = fit(ppo, models, optimiser, count, key=keys, throw=False, block=400)
    return found.model.policy.base, batch * horizon * (rounds + 1)


def by_shac(env, keys, steps):
    """The same by the short-horizon actor-critic."""
    batch, horizon = 16, 50
    # Every tenth step runs a second batch for the scales, and the start runs two.
    count = max(1, round((steps / (batch * horizon) - 2) / 1.1))
    shac = SHAC(dlx.replace(env, SPREAD), batch, horizon, window=10, discount=0.95)
    schedule = optax.linear_schedule(1e-2, 1e-3, count)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
    models = eqx.filter_vmap(lambda key: actor_critic(env, 32, 1, key=key))(keys)
    found = fit(shac, models, optimiser, count, key=keys, throw=False, block=400)
    used = batch * horizon * (count + (count - 1) // 10 + 2)
    return found.model.policy.base, used


def by_gradient(env, keys, steps):
    """The same by the gradient of the rollout, damped by 0.92 a step."""
    batch, horizon = 16, 100
    count = max(1, round(steps / (batch * horizon)))
    loss = expected_cost(
        dlx.replace(env, SPREAD), batch=batch, horizon=horizon, gradient_decay=0.92
    )
    optimiser = optax.adam(optax.cosine_decay_schedule(0.01, count))
    make = lambda key: dlx.controllers.Deep(env, width=32, depth=1, key=key)
    models = eqx.filter_vmap(make)(keys)
    found = fit(loss, models, optimiser, count, key=keys, throw=False, block=400)
    return found.model, batch * horizon * count


def swing_up(small: bool) -> dict[str, Any]:
    """PPO on ten seeds: at least 95 of 100 starts on at least 8 of them."""
    env = dlx.make("pendulum")
    seeds = 2 if small else 10
    begin = time.perf_counter()
    keys = jr.split(jr.key(FIRST_SEED), seeds)
    policies, used = by_ppo(env, keys, 16_000 if small else 161_600, 64, 2, 1e-3)
    jax.block_until_ready(jax.tree.leaves(eqx.filter(policies, eqx.is_array)))
    seconds = time.perf_counter() - begin
    held = np.asarray(evaluated(env, policies)[0])
    reached = f"{int(np.sum(held >= 95))} of {seeds}"
    rows = [
        {
            "environment steps a seed": used,
            "seconds for all seeds, compile included": seconds,
            "seeds with 95 of 100": reached,
            "held of 100": held.tolist(),
        }
    ]
    shown(rows, "PPO swings the pendulum up")
    return rows[0]


def interquartile(values: np.ndarray, key: int = 0) -> list[float]:
    """The interquartile mean, and the ends of its 95% interval by the bootstrap."""

    def mean(values):
        cut = np.sort(values, axis=-1)
        n = cut.shape[-1]
        return cut[..., n // 4 : n - n // 4].mean(axis=-1)

    rng = np.random.default_rng(key)
    again = rng.choice(values, (2000, len(values)))
    return [float(mean(values)), *map(float, np.quantile(mean(again), [0.025, 0.975]))]


def learning(small: bool) -> dict[str, Any]:
    """The cost of 200 steps from the starts of Gym, after so many steps of training."""
    env = dlx.make("pendulum")
    seeds = 3 if small else 30
    keys = jr.split(jr.key(FIRST_SEED + 1), seeds)
    methods = {"PPO": by_ppo, "SHAC": by_shac, "analytic": by_gradient}
    rows = []
    for steps in (16_000,) if small else (40_000, 80_000, 160_000, 320_000):
        for name, train in methods.items():
            begin = time.perf_counter()
            policies, used = train(env, keys, steps)
            held, cost = (np.asarray(a) for a in evaluated(env, policies))
            seconds = time.perf_counter() - begin
            mean, low, high = interquartile(cost)
            rows.append(
                {
                    "method": name,
                    "steps": used,
                    "cost, IQM": mean,
                    "low": low,
                    "high": high,
                    "held of 100, median": float(np.median(held)),
                    "seeds with 95": int(np.sum(held >= 95)),
                    "seconds, all seeds": seconds,
                }
            )
            print(f"  {rows[-1]}", flush=True)
    zero = eqx.filter_vmap(lambda _: dlx.controllers.Constant([0.0]), axis_size=1)(
        jnp.zeros(1)
    )
    held, cost = evaluated(env, zero)
    rows.append({"method": "zero control", "cost, IQM": float(cost[0])})
    shown(rows, f"Swing-up at equal steps of the environment, {seeds} seeds")
    return {"seeds": seeds, "rows": rows}


def main() -> None:
    """Run the parts that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=PARTS, action="append")
    parser.add_argument("--small", action="store_true", help="to try it; not written")
    arguments = parser.parse_args()
    runs = dict(zip(PARTS, (figure, variance, swing_up, learning), strict=True))
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    results["machine"] = describe()
    for part in arguments.part or PARTS:
        print(f"\n== {part}", flush=True)
        begin = time.perf_counter()
        found = runs[part](arguments.small)
        found["seconds"] = time.perf_counter() - begin
        results[part] = found
        if not arguments.small:
            RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    limit_cores(1)
    main()
