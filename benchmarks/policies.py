"""`python -m benchmarks.policies`: training by the gradient, by PPO and by SHAC.

Parts, written to `benchmarks/results/policies.json` when they are done:

- `swing-up`: the analytic gradient and PPO, ten seeds each, with the steps and the
  seconds that they take;
- `tuning`: eight settings of each method, on seeds that are not among those reported;
- `learning`: PPO, SHAC and the analytic gradient at equal steps of the environment, 30
  seeds, with the best of these; draws `docs/assets/learning.svg`. `--steps 40000` runs
  one of the budgets;

and those that store each case in a file of their own, `results/*.jsonl`, and go on
where they were cut off (a case that is stored is not run again, unless `--fresh` is
given):

- `tasks`: every named task by `training.synthesise`, five seeds each; `--task pendulum`
  runs one;
- `ablation`: the same without one of its parts, on tasks of each kind;
- `family`: one policy for a family of cart-poles, beside LQR and MPC that know each
  plant;
- `rivals`: PPO and SAC of Stable-Baselines3 at 20 times the seconds (needs the group
  `sb3`);
- `export`: the policies in C.

`--page` puts the tables of these into `docs/policy_results.md`, and draws the figure.

With `--at-once 2` two cases share the cores, each with the same seconds.

How the estimators compare is in the paper's studies: `python -m delucax reproduce
policy-gradient` and `estimator-variance`.
"""

import argparse
import itertools
import json
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
from benchmarks._ablation import ablation
from benchmarks._exported_policies import exported
from benchmarks._family import family
from benchmarks._machine import compile_anew, describe, limit_cores
from benchmarks._paired import middle, spread
from benchmarks._policy_page import write
from benchmarks._results import updated
from benchmarks._rivals import rivals
from benchmarks._synthesis import tasks
from delucax.studies import holds_upright, train_swing_up
from delucax.training import (
    actor_critic,
    expected_cost,
    fit,
    PPO,
    SHAC,
)


RESULTS = Path(__file__).parent / "results" / "policies.json"
FIGURE = Path(__file__).parents[1] / "docs" / "assets" / "learning.svg"
PARTS = (
    "swing-up",
    "tuning",
    "learning",
    "tasks",
    "ablation",
    "family",
    "rivals",
    "export",
)
BUDGETS = (40_000, 80_000, 160_000, 320_000)
"""Steps of the environment that a seed is trained for."""
STARTS = 100
LEAST = {"analytic": 10, "PPO, all seeds at once": 8}
"""Seeds of 10 that hold 95 of 100 starts."""
MOST_SECONDS = 5.0
"""Of a seed by the analytic gradient, with compilation."""
FIRST_SEED = 1000
CORNER = np.array([np.pi, 8.0])
QUIETLY: Any = dict(throw=False, block=400, progress=False)
SPREAD = {"initial_state.low": -CORNER, "initial_state.high": CORNER}


def shown(rows: list[dict[str, Any]], title: str) -> list[dict[str, Any]]:
    """Print a table, and give it back."""
    print(f"\n{title}")
    table = pd.DataFrame(rows)
    print(table.to_string(index=False, float_format="%.4g", na_rep=""), flush=True)
    return rows


@eqx.filter_jit
def evaluated(env: Any, policies: Any) -> tuple[Any, Any]:
    """`(starts of 100 held upright, mean cost of 200 steps)` of each of a batch."""
    starts = jax.vmap(env.reset)(jr.split(jr.key(2**20), STARTS))

    def one(policy):
        options: Any = dict(key=jr.key(0), horizon=400, throw=False)
        run = jax.vmap(lambda x0: dlx.rollout(env, policy, x0=x0, **options))(starts)
        costs = jnp.asarray(run.costs)
        return jnp.sum(holds_upright(run)), jnp.mean(jnp.sum(costs[:, :200], 1))

    return eqx.filter_vmap(one)(policies)


def by_ppo(env, keys, steps, width=32, depth=1, rate=3e-3, discount=0.95, epochs=10):
    """`(policies, steps of the environment that each seed took)`."""
    batch, horizon, minibatches = 32, 50, 8
    rounds = max(1, round(steps / (batch * horizon)) - 1)
    ppo = PPO(
        dlx.replace(env, SPREAD),
        batch,
        horizon,
        discount=discount,
        epochs=epochs,
        minibatches=minibatches,
    )
    count = rounds * epochs * minibatches
    schedule = optax.linear_schedule(rate, rate / 10, count)
    optimiser = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(schedule))
    make = lambda key: actor_critic(env, width, depth, key=key)
    models = eqx.filter_vmap(make)(keys)
    fitted = fit(ppo, models, optimiser, count, key=keys, **QUIETLY)
    return fitted.model.policy.base, batch * horizon * (rounds + 1)


def by_shac(env, keys, steps, batch=16, window=10, rate=1e-2):
    """The same by the short-horizon actor-critic."""
    horizon = 50
    # Every tenth step runs a second batch for the scales, and the start runs two.
    count = max(1, round((steps / (batch * horizon) - 2) / 1.1))
    shac = SHAC(dlx.replace(env, SPREAD), batch, horizon, window=window, discount=0.95)
    schedule = optax.linear_schedule(rate, rate / 10, count)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
    models = eqx.filter_vmap(lambda key: actor_critic(env, 32, 1, key=key))(keys)
    fitted = fit(shac, models, optimiser, count, key=keys, **QUIETLY)
    used = batch * horizon * (count + (count - 1) // 10 + 2)
    return fitted.model.policy.base, used


def by_gradient(env, keys, steps, batch=8, horizon=100, rate=1e-2):
    """The same by the gradient of the rollout, damped by 0.92 a step."""
    count = max(1, round(steps / (batch * horizon)))
    loss = expected_cost(
        dlx.replace(env, SPREAD), batch=batch, horizon=horizon, gradient_decay=0.92
    )
    optimiser = optax.adam(optax.cosine_decay_schedule(rate, count))
    make = lambda key: dlx.controllers.mlp_policy(env, width=32, depth=1, key=key)
    models = eqx.filter_vmap(make)(keys)
    fitted = fit(loss, models, optimiser, count, key=keys, **QUIETLY)
    return fitted.model, batch * horizon * count


METHODS = {"PPO": by_ppo, "SHAC": by_shac, "analytic": by_gradient}


def product(**values: tuple[Any, ...]) -> list[dict[str, Any]]:
    """Every choice of one of each."""
    each = itertools.product(*values.values())
    return [dict(zip(values, chosen, strict=True)) for chosen in each]


SPACE = {
    "PPO": product(rate=(1e-3, 3e-3), discount=(0.9, 0.95), epochs=(5, 10)),
    "SHAC": product(batch=(4, 16), window=(10, 25), rate=(3e-3, 1e-2)),
    "analytic": product(batch=(2, 8), horizon=(50, 100), rate=(3e-3, 1e-2)),
}
"""What was tried, eight settings a method, at `TUNED_AT` steps on five other seeds."""
TUNED_AT = 160_000


def tuning(options: argparse.Namespace) -> dict[str, Any]:
    """The cost of each setting, and the best one of each method."""
    env, made = dlx.make("pendulum"), {}
    keys = jr.split(jr.key(FIRST_SEED + 2), 2 if options.small else 5)
    for name, train in METHODS.items():
        rows = []
        for setting in SPACE[name]:
            steps = 16_000 if options.small else TUNED_AT
            policies, _ = train(env, keys, steps, **setting)
            cost = np.asarray(evaluated(env, policies)[1])
            rows.append(setting | {"cost": middle(np.where(cost < 1e9, cost, 1e9))})
            print(f"  {name}: {rows[-1]}", flush=True)
        made[name] = rows
    return made


def best(tuned: dict[str, Any], name: str) -> dict[str, Any]:
    """The setting that was best."""
    costs = [row["cost"] for row in tuned[name]]
    return SPACE[name][int(np.argmin(costs))]


def held_by(env: Any, policies: Any) -> np.ndarray:
    """Starts of 100 held upright, of each of a batch of policies."""
    return np.asarray(evaluated(env, policies)[0])


def swing_up(options: argparse.Namespace) -> dict[str, Any]:
    """The analytic gradient and PPO on ten seeds: at least 95 of 100 starts."""
    env = dlx.make("pendulum")
    seeds = 2 if options.small else 10
    models, taken = [], []
    for seed in range(seeds):
        begin = time.perf_counter()
        key = jr.key(FIRST_SEED + seed)
        model = train_swing_up(env, key=key, progress=False).model
        models.append(jax.block_until_ready(model))
        taken.append(time.perf_counter() - begin)
    held = [int(held_by(env, jax.tree.map(one_more, m))[0]) for m in models]
    # The first one compiles.
    rows = [
        {
            "method": "analytic",
            "steps a seed": 800 * 128 * 100,
            "seeds with 95 of 100": int(np.sum(np.array(held) >= 95)),
            "seconds": taken,
            "held of 100": held,
        }
    ]
    begin = time.perf_counter()
    keys = jr.split(jr.key(FIRST_SEED), seeds)
    steps = 16_000 if options.small else 161_600
    policies, used = by_ppo(env, keys, steps, 64, 2, 1e-3)
    jax.block_until_ready(jax.tree.leaves(eqx.filter(policies, eqx.is_array)))
    seconds = time.perf_counter() - begin
    held = held_by(env, policies).tolist()
    rows.append(
        {
            "method": "PPO, all seeds at once",
            "steps a seed": used,
            "seeds with 95 of 100": int(np.sum(np.array(held) >= 95)),
            "seconds": [seconds],
            "held of 100": held,
        }
    )
    shown(rows, f"The pendulum is swung up, {seeds} seeds")
    return {"seeds": seeds, "rows": rows, "limits": judged(rows, seeds)}


def judged(rows: list[dict[str, Any]], seeds: int) -> list[dict[str, Any]]:
    """Print and give each limit of the swing-up, and whether it is met."""
    made = []
    for row in rows:
        least, holds = LEAST[row["method"]] * seeds / 10, row["seeds with 95 of 100"]
        made.append((f"{row['method']}, seeds at least", least, holds, holds >= least))
        if row["method"] == "analytic":
            most = max(row["seconds"])
            met = most <= MOST_SECONDS
            made.append(("analytic, s a seed at most", MOST_SECONDS, most, met))
    for what, limit, reached, met in made:
        print(f"{what} {limit:g}: {reached:.3g}, {'met' if met else 'NOT met'}")
    names = "what", "limit", "reached", "met"
    return [dict(zip(names, each, strict=True)) for each in made]


def one_more(leaf: Any) -> Any:
    """With an axis in front."""
    return leaf[None] if eqx.is_array(leaf) else leaf


def learning(options: argparse.Namespace) -> dict[str, Any]:
    """The cost of 200 steps from the starts of Gym, after so many steps of training."""
    chosen = json.loads(RESULTS.read_text())["tuning"]
    env = dlx.make("pendulum")
    seeds = 3 if options.small else 30
    keys = jr.split(jr.key(FIRST_SEED + 1), seeds)
    budgets = (16_000,) if options.small else BUDGETS
    if options.steps is not None:
        budgets = (options.steps,)
    rows: list[dict[str, Any]] = []
    for budget in budgets:
        for name, train in METHODS.items():
            begin = time.perf_counter()
            policies, used = train(env, keys, budget, **best(chosen, name))
            held, cost = (np.asarray(a) for a in evaluated(env, policies))
            seconds = time.perf_counter() - begin
            mean, low, high = spread(cost)
            rows.append(
                {
                    "budget": budget,
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
    still = jax.tree.map(one_more, dlx.controllers.Constant(jnp.zeros(1)))
    _, cost = evaluated(env, still)
    rows.append({"budget": 0, "method": "zero control", "cost, IQM": float(cost[0])})
    shown(rows, f"Swing-up at equal steps of the environment, {seeds} seeds")
    settings = {name: best(chosen, name) for name in METHODS}
    return {"seeds": seeds, "settings": settings, "rows": rows}


def draw(rows: list[dict[str, Any]]) -> None:
    """Cost against steps."""
    import matplotlib.pyplot as plt

    plt.style.use("delucax.plotting.style")
    figure, ax = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
    table = pd.DataFrame(rows)
    for name, group in table[table["budget"] > 0].groupby("method", sort=False):
        off = [group["cost, IQM"] - group["low"], group["high"] - group["cost, IQM"]]
        ax.errorbar(
            group["steps"],
            group["cost, IQM"],
            off,
            fmt="o-",
            ms=3,
            capsize=3,
            label=name,
        )
    zero = table.loc[table["budget"] == 0, "cost, IQM"].iloc[0]
    ax.axhline(zero, color="0.5", ls=":", label="zero control")
    ax.set(xlabel="steps of the environment", ylabel="cost of 200 steps", xscale="log")
    ax.set_xticks(BUDGETS, [f"{budget:,}" for budget in BUDGETS])
    ax.minorticks_off()
    ax.legend()
    figure.savefig(FIGURE, metadata={"Date": None})


def main() -> None:
    """Run the parts that are named."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.policies",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--part", choices=PARTS, action="append", help="all by default")
    parser.add_argument("--steps", type=int, choices=BUDGETS, help="one budget, again")
    parser.add_argument("--task", action="append", default=[], help="one task alone")
    parser.add_argument("--seeds", type=int, help="of each case; 5, or 3 of rivals")
    parser.add_argument("--at-once", type=int, default=1, help="cases at a time")
    parser.add_argument(
        "--fresh",
        action="store_true",
        help="forget what is stored of the chosen parts, tasks and seeds, and run it "
        "again; if this run is cut off, go on without it",
    )
    parser.add_argument(
        "--small",
        action="store_true",
        help="to try swing-up, tuning or learning; not written",
    )
    parser.add_argument("--page", action="store_true", help="the tables and the figure")
    options = parser.parse_args()
    if options.page:
        write(RESULTS)
        draw(json.loads(RESULTS.read_text())["learning"]["rows"])
        return
    compile_anew()
    about = {"machine": describe()}
    runs = {"swing-up": swing_up, "tuning": tuning, "learning": learning}
    seeds = {} if options.seeds is None else {"seeds": options.seeds}
    how: dict[str, Any] = {"at_once": options.at_once, "fresh": options.fresh}
    row_by_row = {
        "tasks": lambda: tasks(options.task, **seeds, **how),
        "ablation": lambda: ablation(options.task, **seeds, **how),
        "family": lambda: family(**seeds, **how),
        "rivals": lambda: rivals(options.task, **seeds, **how),
        "export": lambda: exported(options.task, **how),
    }
    parts = options.part or PARTS
    if options.small and not row_by_row.keys().isdisjoint(parts):
        parser.error(f"--small is not for {', '.join(row_by_row)}: use --task, --seeds")
    for part in parts:
        print(f"\n== {part}", flush=True)
        if part in row_by_row:
            reached = row_by_row[part]()
            # A selection is not what the pages tell of.
            if not options.task and options.seeds is None:
                updated(RESULTS, lambda old, p=part, r=reached: about | {p: r})
            continue
        result = runs[part](options)
        if options.small:
            continue
        if part != "learning":
            updated(RESULTS, lambda old, p=part, r=result: about | {p: r})
            continue
        content = updated(
            RESULTS, lambda old, r=result: about | {"learning": both(old, r)}
        )
        draw(content["learning"]["rows"])


def both(content: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """The new rows, with the budgets that were run before."""
    ran = {row["budget"] for row in new["rows"]}
    old = [
        row
        for row in content.get("learning", {}).get("rows", [])
        if row["budget"] not in ran
    ]
    rows = sorted([*old, *new["rows"]], key=lambda row: row["budget"])
    return new | {"rows": rows}


if __name__ == "__main__":
    limit_cores(1)
    main()
