"""`python -m benchmarks.regret`: the regret of online learners against hindsight.

Four plants, seven kinds of disturbance, 20 seeds, T from 500 to 20,000 in double
precision. The comparator is the best fixed policy of the learner's own class and memory
for the first T steps, found anew for each T. Prints a table, and writes
`benchmarks/results/regret.json` and `docs/assets/regret.svg`.

A learner plays once to the last T, and its first T steps are what is charged up to T;
`Explore`, which has to know T, plays once for each. The limits below were written
before the first run. The learners have their defaults; nothing was tuned.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pandas as pd
from jaxtyping import Array

import delucax as dlx
from benchmarks._machine import describe, keep_programs, limit_cores
from delucax._figures import PALETTE


ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results" / "regret.json"
FIGURE = ROOT / "docs" / "assets" / "regret.svg"
LENGTHS = (500, 1000, 2000, 5000, 10_000, 20_000)
SEEDS = 20
SLOPE = {"GPC": 0.55, "DRC": 0.55, "Explore": 0.75}
"""The upper end of the 95% interval of the slope is to be at most this."""
RELATIVE = 0.10
"""Regret over T at the last T is to be at most this part of the comparator's cost."""
DIVERGED = 1e3
"""A run that costs more than so many times the comparator has diverged."""

c = dlx.controllers


class Plant(NamedTuple):
    """Where a learner is tried.

    - `learner`: its name in the table of limits.
    - `env`: its cost is the sum of squares of observation and control.
    - `base`: the regulator that it is compared with.
    - `play`: makes the controller for a number of steps.
    - `anew`: whether that depends on the number.
    - `best`: the class of policies that hindsight chooses from.
    - `size`: of the disturbances.
    """

    learner: str
    env: dlx.Environment
    base: dlx.AbstractController
    play: Callable[[int], dlx.AbstractController]
    anew: bool
    best: Any
    size: float


def plants() -> dict[str, Plant]:
    """A linear plant, one that is seen in part, a nonlinear one, one not known."""
    one, two = jnp.eye(1), jnp.eye(2)
    both = dlx.costs.Quadratic(two, one)
    push = jnp.array([[0.0], [1.0]])
    found = {}

    double = dlx.LinearDynamics(jnp.array([[1.0, 1.0], [0.0, 1.0]]), push)
    learner = c.gpc(double, both)
    found["double integrator"] = Plant(
        "GPC",
        dlx.Environment(double, both),
        c.LQR(double, two, one),
        lambda T, learner=learner: learner,
        False,
        learner.fixed(),
        1.0,
    )

    C = jnp.array([[1.0, 0.0]])
    partial = dlx.LinearDynamics(jnp.array([[0.9, 0.5], [0.0, 0.9]]), push, C)
    learner = c.drc(partial, dlx.costs.Quadratic(one, one))
    found["one output of two states"] = Plant(
        "DRC",
        dlx.Environment(partial, dlx.costs.Quadratic(C.T @ C, one)),
        learner.loop.base,
        lambda T, learner=learner: learner,
        False,
        learner.fixed(),
        1.0,
    )

    pendulum = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
    learner = c.gpc(pendulum, both)
    found["pendulum, upright"] = Plant(
        "GPC",
        dlx.Environment(pendulum, both),
        learner.loop.base,
        lambda T, learner=learner: learner,
        False,
        learner.fixed(),
        # Small enough to stay near upright.
        0.02,
    )

    stable = dlx.LinearDynamics(jnp.array([[0.8, 0.5], [0.0, 0.8]]), push)
    learner = c.gpc(stable, both, horizon=15)

    def build(model):
        # Newton's long steps follow the error of an estimated model; this is the
        # published first-order learner.
        return c.gpc(model, both, horizon=15, optimiser=c.adagrad_norm())

    found["unknown, stable"] = Plant(
        "Explore",
        dlx.Environment(stable, both),
        c.LQR(stable, two, one),
        lambda T: c.Explore(build, jnp.zeros((1, 2)), round(T ** (2 / 3))),
        True,
        learner.fixed(),
        # Below the random controls, 1, which are to be seen through them.
        0.3,
    )
    return found


def sequences(seeds: int, steps: int) -> dict[str, np.ndarray]:
    """Disturbances of unit power in each of two states, shape (seeds, steps, 2)."""
    rng = np.random.default_rng(2026)
    shape = (seeds, steps, 2)
    t = np.arange(steps)[:, None]
    draw = lambda low, high: rng.uniform(low, high, (seeds, 1, 2))  # noqa: E731
    wave = 2 * np.pi * t * np.exp(draw(np.log(0.005), np.log(0.1)))
    noise = rng.normal(size=shape)
    walk = np.empty(shape)
    walk[:, 0] = noise[:, 0]
    for k in range(1, steps):
        walk[:, k] = 0.95 * walk[:, k - 1] + np.sqrt(1 - 0.95**2) * noise[:, k]
    halves = draw(20, 200)
    return {
        "Gaussian": rng.normal(size=shape),
        "uniform": rng.uniform(-np.sqrt(3), np.sqrt(3), shape),
        "AR(1)": walk,
        "sine": np.sqrt(2) * np.sin(wave + draw(0, 2 * np.pi)),
        "constant": np.broadcast_to(np.sign(draw(-1, 1)) * draw(0.5, 1.3), shape),
        "square": np.where((t + draw(0, 400)) // halves % 2 < 1, 1.0, -1.0),
    }


def attacks(plant: Plant, seeds: int, steps: int) -> Array:
    """The worst disturbances of bounded size for the learner at its defaults."""
    learner = plant.play(steps)
    if plant.anew:
        # Aimed at what it becomes once it knows the plant.
        learner = c.gpc(plant.env.dynamics, plant.env.cost, horizon=15)

    def attack(key):
        options: Any = dict(x0=jnp.zeros(2), horizon=steps, iterations=4, starts=2)
        bound = plant.size * jnp.sqrt(2.0)
        return dlx.training.worst_case(
            plant.env, learner, key=key, bound=bound, **options
        )

    found = jax.jit(lambda keys: lax.map(lambda key: attack(key).w, keys))
    return found(jr.split(jr.key(7), seeds))


@jax.jit
def played(env: dlx.Environment, controller: Any, w: Array) -> tuple[Array, Array]:
    """The costs so far at each step of each lane, and how far the state went."""

    def run(key, w):
        options: Any = dict(key=key, x0=jnp.zeros(2), horizon=len(w), throw=False)
        found = dlx.rollout(env, controller, w=w, keep=("costs", "states"), **options)
        return jnp.cumsum(found.costs), jnp.max(jnp.abs(found.states), axis=0)

    return jax.vmap(run)(jr.split(jr.key(3), len(w)), w)


@jax.jit
def responses(env: dlx.Environment, policy: Any, theta: Array, w: Array) -> Any:
    """Of one lane: observation and control of each step under the policy with `theta`,
    and their derivatives by theta."""
    shape = policy.policy.start.shape

    def run(theta):
        tried = dlx.replace(policy, {"policy.start": theta.reshape(shape)})
        keep: Any = ("observations", "controls")
        options: Any = dict(key=jr.key(0), x0=jnp.zeros(2), horizon=len(w), throw=False)
        found = dlx.rollout(env, tried, w=w, keep=keep, **options)
        return jnp.concatenate([found.observations, found.controls], axis=1)

    along = lambda direction: jax.jvp(run, (theta,), (direction,))[1]  # noqa: E731
    return run(theta), jax.vmap(along)(jnp.eye(len(theta)))


def nearest(z: np.ndarray, J: np.ndarray) -> np.ndarray:
    """The step of theta that makes the sum of squares of `z + J step` least."""
    J = J.reshape(len(J), -1)
    values, vectors = np.linalg.eigh(J @ J.T)
    # What hardly moves anything, as most of a policy does under a constant push.
    kept = values > 1e-12 * values[-1]
    along = vectors[:, kept]
    return -along @ ((along.T @ (J @ z.ravel())) / values[kept])


def hindsight(plant: Plant, w: Array, lengths: tuple[int, ...]) -> list[float]:
    """The least cost of the class over the first steps of one lane.

    The cost is a sum of squares, and of a linear loop the response is linear in theta:
    one least-squares problem a length. Of the pendulum's it is solved again about the
    policy that was found (the method of Gauss and Newton).
    """
    linear = isinstance(plant.env.dynamics, dlx.LinearDynamics)
    zero = jnp.zeros(plant.best.policy.start.size)
    here = [np.asarray(x) for x in responses(plant.env, plant.best, zero, w)]
    least = []
    for T in lengths:
        z, J = here[0][:T], here[1][:, :T]
        theta = nearest(z, J)
        if linear:
            least.append(float(np.sum((z + np.einsum("p,ptq->tq", theta, J)) ** 2)))
            continue
        costs = [np.sum(z**2)]
        for _ in range(3):
            z, J = map(np.asarray, responses(plant.env, plant.best, theta, w[:T]))
            costs.append(np.sum(z**2))
            theta = theta + nearest(z, J)
        least.append(float(np.min(costs)))
    return least


def middle(table: np.ndarray) -> np.ndarray:
    """The interquartile mean over seeds; a run that diverged is the worst there is."""
    ordered = np.sort(np.where(np.isfinite(table), table, np.inf), axis=0)
    quarter = len(ordered) // 4
    return ordered[quarter : len(ordered) - quarter].mean(axis=0)


def slopes(regret: np.ndarray, lengths: np.ndarray) -> dict[str, Any]:
    """The slope on log-log axes, over the seeds whose regret is positive throughout.

    `regret` has shape (seeds, lengths); the interval is that of the mean of the seeds'
    slopes, by the bootstrap.
    """
    logged = regret[np.all((regret > 0) & np.isfinite(regret), axis=1)]
    found = {"seeds with positive regret": len(logged)}
    if len(logged) < 5:
        return found | {"slope": None, "from": None, "to": None}
    x = np.log(lengths) - np.mean(np.log(lengths))
    each = np.log(logged) @ x / (x @ x)
    rng = np.random.default_rng(0)
    means = rng.choice(each, (5000, len(each))).mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return found | {"slope": each.mean(), "from": low, "to": high}


def study(name: str, plant: Plant, lengths: tuple[int, ...], seeds: int) -> list[Any]:
    """A row for each kind of disturbance."""
    last, T = lengths[-1], np.array(lengths)
    kinds = sequences(seeds, last)
    kinds = {kind: plant.size * jnp.asarray(w) for kind, w in kinds.items()}
    kinds["worst case"] = attacks(plant, seeds, last)
    w = jnp.concatenate(list(kinds.values()))
    at = T - 1
    base, _ = played(plant.env, plant.base, w)
    if plant.anew:
        runs = [played(plant.env, plant.play(n), w[:, :n]) for n in lengths]
        costs = np.stack([np.asarray(cost[:, -1]) for cost, _ in runs], axis=1)
        reached = runs[-1][1]
    else:
        run, reached = played(plant.env, plant.play(last), w)
        costs = np.asarray(run[:, at])
    best = np.array([hindsight(plant, lane, lengths) for lane in w])
    rows = []
    for k, kind in enumerate(kinds):
        part = slice(k * seeds, (k + 1) * seeds)
        least = best[part]
        diverged = ~(costs[part] < DIVERGED * least)
        regret = np.where(diverged, np.inf, costs[part] - least)
        regulated = np.asarray(base[part, at]) - least
        row: dict[str, Any] = {"plant": name, "learner": plant.learner}
        row |= {"disturbance": kind} | slopes(regret, T)
        row["limit"] = SLOPE[plant.learner]
        row["slope of the regulator"] = slopes(regulated, T)["slope"]
        relative = regret[:, -1] / least[:, -1]
        row["runs diverged"] = int(diverged.sum())
        row["regret / cost of hindsight"] = middle(relative)
        row["of the regulator"] = middle(regulated[:, -1] / least[:, -1])
        row["slope ok"] = row["to"] is None or row["to"] <= row["limit"]
        row["relative ok"] = row["regret / cost of hindsight"] <= RELATIVE
        row["furthest state"] = np.max(np.asarray(reached[part]), axis=0).tolist()
        for what, table in {"regret": regret, "regulator": regulated}.items():
            row[f"{what}, mean"] = middle(table).tolist()
            row[f"{what}, each"] = np.round(table, 6).tolist()
        row["cost of hindsight, mean"] = middle(least).tolist()
        rows.append(row)
    return rows


def checked(plant: Plant, steps: int = 1000) -> float:
    """By how much `best_in_hindsight` is better, relative to the cost, on one lane."""
    w = plant.size * jnp.asarray(sequences(1, steps)["AR(1)"])[0]
    options: Any = dict(key=jr.key(0), x0=jnp.zeros(2), horizon=steps)
    run = dlx.rollout(plant.env, plant.base, w=w, **options)
    found = c.best_in_hindsight(plant.env, plant.best, run).trajectory.total_cost
    return float(hindsight(plant, w, (steps,))[0] / found - 1)


def plain(content: Any) -> Any:
    """As JSON has it: what diverged is null."""
    if isinstance(content, dict):
        return {key: plain(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [plain(value) for value in content]
    if isinstance(content, float | np.floating):
        return float(content) if np.isfinite(content) else None
    return content.item() if isinstance(content, np.generic) else content


def draw(rows: list[dict[str, Any]], lengths: tuple[int, ...]) -> None:
    """Regret, the interquartile mean over seeds, against T, a panel a plant."""
    import matplotlib.pyplot as plt

    plt.style.use("delucax.plotting.style")
    plt.rcParams["font.size"] = 9

    names = list(dict.fromkeys(row["plant"] for row in rows))
    kinds = dict.fromkeys(row["disturbance"] for row in rows)
    colours = dict(zip(kinds, [*PALETTE, "0.2"], strict=True))
    T = np.array(lengths, float)
    figure, axes = plt.subplots(1, len(names), figsize=(11, 3.6), layout="constrained")
    for ax, name in zip(axes, names, strict=True):
        here = [row for row in rows if row["plant"] == name]
        for row in here:
            colour = colours[row["disturbance"]]
            for what, line, width in (("regret", "o-", 1.4), ("regulator", ":", 1)):
                y = np.array(row[f"{what}, mean"], float)
                y = np.where(y > 0, y, np.nan)
                label = row["disturbance"] if what == "regret" else None
                ax.loglog(T, y, line, color=colour, lw=width, ms=3, label=label)
        low, high = ax.get_ylim()
        start = np.max([row["regret, mean"][0] for row in here])
        slope = 2 / 3 if here[0]["learner"] == "Explore" else 1 / 2
        guide = 1.8 * start * (T / T[0]) ** slope
        ax.loglog(T, guide, "--", color="0.4", lw=1)
        text = "$T^{2/3}$" if slope > 0.6 else r"$\sqrt{T}$"
        ax.annotate(text, (T[2], guide[2]), (-4, 7), textcoords="offset points")
        ax.set_ylim(low, high)
        ax.set_title(f"{here[0]['learner']}: {name}", fontsize=9)
        ax.set_xlabel("steps T")
    axes[0].set_ylabel("regret (dotted: the regulator's)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=7)
    FIGURE.parent.mkdir(exist_ok=True)
    figure.savefig(FIGURE, metadata={"Date": None})


def main() -> None:
    """Run, print, draw and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.regret")
    parser.add_argument("--quick", action="store_true", help="small sizes, no file")
    parser.add_argument("--draw", action="store_true", help="the figure alone, again")
    options = parser.parse_args()
    if options.draw:
        content = json.loads(RESULTS.read_text())
        draw(content["rows"], tuple(content["lengths"]))
        return
    limit_cores(1)
    keep_programs()
    jax.config.update("jax_enable_x64", True)
    lengths, seeds = (LENGTHS[:3], 5) if options.quick else (LENGTHS, SEEDS)
    rows: list[dict[str, Any]] = []
    gaps = {}
    for name, plant in plants().items():
        start = time.perf_counter()
        gaps[name] = checked(plant)
        rows += study(name, plant, lengths, seeds)
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    shown = pd.DataFrame(rows).drop(
        columns=[k for k in rows[0] if k.endswith(("mean", "each", "state"))]
    )
    for name, table in shown.groupby("plant", sort=False):
        print(f"\n{name}")
        columns = table.drop(columns="plant")
        print(columns.to_string(index=False, float_format="%.3f", na_rep=""))
    print("\nWhat best_in_hindsight finds better, relative to the cost:")
    print(pd.Series(gaps).to_string(float_format="%.1e"))
    if not options.quick:
        content = {"machine": describe(), "seeds": seeds, "lengths": lengths}
        content |= {"limits": {"slope": SLOPE, "relative": RELATIVE}}
        content |= {"hindsight, checked": gaps, "rows": rows}
        RESULTS.write_text(json.dumps(plain(content), indent=1) + "\n")
        draw(rows, lengths)
        print(f"\nwritten: {RESULTS}, {FIGURE}")


if __name__ == "__main__":
    main()
