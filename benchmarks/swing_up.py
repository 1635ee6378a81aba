"""`python -m benchmarks.swing_up`: the cart-pole and the acrobot are swung up by
planning once, by planning at every step, and by a policy that was trained.

Ten seconds of 0.05 s from 100 starts, the same for all, in double precision on one
core: the cart-pole from any angle with up to 10 N, the acrobot from hanging with up to
10 N m. Held is who stays within 0.2 rad of upright (each angle) for the last two
seconds. iLQR plans five seconds, and LQR takes over. Prints tables and writes
`benchmarks/results/swing_up.json`. `--part` runs a plant, `--method` one of its rows
again.

The policy is trained by the gradient of the rollout, damped by a factor a step, on
three seeds; the seconds have compilation in them. The limits were written before the
first run, and settings were chosen on other starts and seeds.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pandas as pd

import delucax as dlx
from benchmarks._machine import compile_anew, describe, limit_cores
from benchmarks._results import updated
from delucax.training import expected_cost, fit


RESULTS = Path(__file__).parent / "results" / "swing_up.json"
LIMITS = {
    "cartpole": {"zero": 0, "iLQR": 95, "MPC": 95, "policy gradient": 95},
    "acrobot": {"zero": 0, "iLQR": 95, "MPC": 80, "policy gradient": 80},
}
"""Starts of 100 that are held at least; at most, for zero control."""
METHODS = ("zero", "iLQR", "MPC", "policy gradient")
STARTS, STEPS, DT, LATE, NEAR = 100, 200, 0.05, 40, 0.2
PLANNED, BATCH, SEEDS = 100, 64, 3
AHEAD = {"cartpole": (40, 10), "acrobot": (60, 20)}
"""Steps that MPC looks ahead, and iterations of a plan at most."""


class Upright(dlx.AbstractCost):
    """What a cart-pole lacks in height, with its place, speeds and effort."""

    def state(self, x):
        rates = 0.02 * (x[1] * x[1] + x[3] * x[3])
        return 1 - jnp.cos(x[2]) + 0.1 * x[0] * x[0] + rates

    def __call__(self, t, x, u):
        return self.state(x) + 0.001 * u[0] * u[0]

    def final(self, t, x):
        return 20 * self.state(x)


class Tip(dlx.AbstractCost):
    """What the tip of an acrobot lacks in height, with its speeds and effort."""

    def state(self, x):
        rates = 0.05 * (x[2] * x[2] + x[3] * x[3])
        return 2 + jnp.cos(x[0]) + jnp.cos(x[0] + x[1]) + rates

    def __call__(self, t, x, u):
        return self.state(x) + 0.001 * u[0] * u[0]

    def final(self, t, x):
        return 100 * self.state(x)


def plant(name: str) -> dlx.Environment:
    """The task, smooth, without an early end."""
    options: Any = dict(
        dt=DT, horizon=STEPS, terminated=None, solver=dlx.dynamics.RK4()
    )
    if name == "cartpole":
        corner = np.array([0.5, 0.5, np.pi, 0.5])
        starts = dlx.environments.UniformState(-corner, corner)
        features = lambda x: jnp.stack(  # noqa: E731
            [x[0], x[1], jnp.cos(x[2]), jnp.sin(x[2]), x[3] / 3]
        )
        options |= dict(cost=Upright(), initial_state=starts, encode=features)
        return dlx.make("cartpole", **options)
    corner = np.full(4, 0.5)
    starts = dlx.environments.UniformState(-corner, corner)
    features = (
        lambda x: jnp.stack(  # noqa: E731
            [*jnp.cos(x[:2]), *jnp.sin(x[:2]), x[2] / 4, x[3] / 6]
        )
    )
    options |= dict(cost=Tip(), initial_state=starts, max_torque=10.0, encode=features)
    return dlx.make("acrobot", **options)


def off_upright(env: dlx.Environment, states: Any) -> Any:
    """The largest angle from upright."""
    top, _ = env.dynamics.equilibrium()
    off = jax.vmap(lambda x: env.dynamics.difference(x, top))(states)
    angles = off[:, 2:3] if env.dynamics.state_names[2] == "angle" else off[:, :2]
    return jnp.max(jnp.abs(angles), axis=1)


def held(env: dlx.Environment, states: Any) -> Any:
    """Whether it stayed upright to the end."""
    return jnp.all(off_upright(env, states[-LATE:]) < NEAR)


def run(env: dlx.Environment, controller: Any, x0: Any, **options: Any) -> Any:
    """A rollout that may fail."""
    options = dict(key=jr.key(0), x0=x0, throw=False) | options
    return dlx.rollout(env, controller, **options)


def flown(one: Any, starts: Any) -> tuple[Any, float]:
    """Which starts are held, the cost of each, and iterations; seconds a start."""
    solve = jax.jit(lambda starts: jax.lax.map(one, starts))
    jax.block_until_ready(solve(starts[:1]))
    began = time.perf_counter()
    found = jax.block_until_ready(solve(starts))
    return found, (time.perf_counter() - began) / len(starts)


def still(env: dlx.Environment, starts: Any) -> dict[str, Any]:
    """The floor."""

    def one(x0):
        out = run(env, dlx.controllers.Zero(1), x0)
        return held(env, out.states), out.total_cost

    (good, cost), _ = flown(one, starts)
    return row("zero", good, cost)


class Landing(dlx.AbstractCost):
    """The cost of the task a tenth as dear on the way and far dearer at the end: a plan
    that is charged for hanging at every step stays in the minimum of who gives up, and
    LQR takes over from near the upright alone."""

    cost: Any

    def __call__(self, t, x, u):
        return 0.1 * self.cost.state(x) + 0.001 * u[0] * u[0]

    def final(self, t, x):
        return 1000 * self.cost.state(x)


class Caught(dlx.AbstractController):
    """A plan, and from its end on a regulator."""

    plan: dlx.planning.Plan
    regulator: dlx.controllers.LQR

    def __call__(self, t, y, state):
        late = t > (PLANNED - 0.5) * DT
        early, _ = self.plan(jnp.where(late, 0.0, t), y, None)
        held, _ = self.regulator(t, y, None)
        return jnp.where(late, held, early), state


def planned(env: dlx.Environment, starts: Any) -> dict[str, Any]:
    """A plan of five seconds, followed with its gains, and LQR from there on."""
    bounds, guess = env.control_bounds, jnp.full((PLANNED, 1), 0.1)
    cost = Landing(env.cost)
    regulator = dlx.controllers.LQR(
        dlx.linearize(env.dynamics),
        jnp.eye(4),
        jnp.eye(1),
        difference=env.dynamics.difference,
    )

    def one(x0):
        options: Any = dict(bounds=bounds, throw=False)
        plan = dlx.planning.ilqr(env.dynamics, cost, x0, guess, **options)
        out = run(env, Caught(plan, regulator), x0)
        return held(env, out.states), out.total_cost, plan.iterations

    (good, cost_of, iterations), seconds = flown(one, starts)
    calls = {"iterations, median": float(jnp.median(iterations))}
    return row("iLQR", good, cost_of) | calls | {"seconds a start": seconds}


def receding(env: dlx.Environment, starts: Any, name: str) -> dict[str, Any]:
    """A plan of two or three seconds at every step."""
    ahead, iterations = AHEAD[name]
    mpc = dlx.controllers.MPC(
        env.dynamics,
        env.cost,
        ahead,
        bounds=env.control_bounds,
        start=jnp.full((ahead, 1), 0.1),
        planner=dlx.planning.ILQR(iterations),
        throw=False,
    )

    def one(x0):
        out = run(env, mpc, x0)
        return held(env, out.states), out.total_cost

    (good, cost), seconds = flown(one, starts)
    return row("MPC", good, cost) | {
        "seconds a start": seconds,
        "ms a step": 1e3 * seconds / STEPS,
    }


SETTINGS: dict[str, dict[str, Any]] = {
    "cartpole": dict(steps=2000, horizon=100, decay=0.95, width=32, rate=0.005),
    "acrobot": dict(steps=2000, horizon=100, decay=0.95, width=64, rate=0.005),
}
"""Of the training; chosen on other seeds."""


def trained(env: dlx.Environment, starts: Any, name: str, seeds: Any) -> dict[str, Any]:
    """A policy of all starts, by the gradient of the rollout."""
    chosen = SETTINGS[name]
    # Fresh starts over the whole state space, so that no part of the swing is new.
    corner = {
        "cartpole": np.array([1.0, 2.0, np.pi, 6.0]),
        "acrobot": np.array([np.pi, 1.0, 2.0, 2.0]),
    }[name]
    wide = {"initial_state.low": -corner, "initial_state.high": corner}
    loss = expected_cost(
        dlx.replace(env, wide),
        batch=BATCH,
        horizon=chosen["horizon"],
        gradient_decay=chosen["decay"],
    )
    steps = chosen["steps"]
    optimiser = optax.chain(
        optax.clip_by_global_norm(10.0),
        optax.adam(optax.cosine_decay_schedule(chosen["rate"], steps)),
    )
    counts, seconds, costs = [], [], []
    for seed in seeds:
        began = time.perf_counter()
        init, key = jr.split(jr.key(seed))
        policy = dlx.controllers.mlp_policy(
            env, width=chosen["width"], depth=2, key=init
        )
        options: Any = dict(key=key, throw=False, progress=False)
        found = fit(loss, policy, optimiser, steps, **options).model
        jax.block_until_ready(eqx.filter(found, eqx.is_array))
        seconds.append(time.perf_counter() - began)

        @eqx.filter_jit
        def score(policy, starts):
            def one(x0):
                out = run(env, policy, x0)
                return held(env, out.states), out.total_cost

            return jax.vmap(one)(starts)

        good, cost = score(found, starts)
        counts.append(int(jnp.sum(good)))
        costs.append(float(jnp.median(cost)))
    return {
        "method": "policy gradient",
        "held of 100": float(np.median(counts)),
        "each seed": counts,
        "cost, median": float(np.median(costs)),
        "steps of training": steps * BATCH * chosen["horizon"],
        "seconds of training": seconds,
    }


def row(method: str, good: Any, cost: Any) -> dict[str, Any]:
    """How many are held, and at what cost."""
    return {
        "method": method,
        "held of 100": 100 * float(np.mean(np.asarray(good))),
        "cost, median": float(jnp.median(cost)),
    }


def study(name: str, methods: Any, quick: bool) -> list[dict[str, Any]]:
    """The rows of a plant."""
    env = plant(name)
    starts = jax.vmap(env.reset)(jr.split(jr.key(0), 4 if quick else STARTS))
    runs: dict[str, Any] = {
        "zero": lambda: still(env, starts),
        "iLQR": lambda: planned(env, starts),
        "MPC": lambda: receding(env, starts, name),
        "policy gradient": lambda: trained(
            env, starts, name, [100] if quick else range(SEEDS)
        ),
    }
    rows = []
    for method in methods:
        found = runs[method]()
        limit, value = LIMITS[name][method], found["held of 100"]
        kept = value <= limit if method == "zero" else value >= limit
        rows.append(found | {"limit": limit, "kept": bool(kept)})
        print(f"  {rows[-1]}", flush=True)
    return rows


def joined(content: dict[str, Any], name: str, rows: Any) -> list[dict[str, Any]]:
    """The rows of a plant, with those of methods that were run before."""
    found = {r["method"]: r for r in [*content.get(name, []), *rows]}
    return [found[method] for method in METHODS if method in found]


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.swing_up")
    parser.add_argument("--quick", action="store_true", help="small sizes, no file")
    parser.add_argument("--part", choices=tuple(LIMITS), help="one plant alone, again")
    parser.add_argument("--method", choices=METHODS, help="one method alone, again")
    options = parser.parse_args()
    limit_cores(1)
    compile_anew()
    jax.config.update("jax_enable_x64", True)
    about = {"machine": describe(), "limits": LIMITS, "settings": SETTINGS}
    methods = [options.method] if options.method else METHODS
    for name in [options.part] if options.part else LIMITS:
        print(name, flush=True)
        rows = study(name, methods, options.quick)
        table = pd.DataFrame(rows)
        print(table.to_string(index=False, float_format="%.4g", na_rep=""), flush=True)
        if not options.quick:
            updated(RESULTS, lambda old, r=rows, n=name: about | {n: joined(old, n, r)})


if __name__ == "__main__":
    main()
