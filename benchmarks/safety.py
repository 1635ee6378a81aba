"""`python -m benchmarks.safety`: what a `controllers.SafetyFilter` keeps, and its cost.

In double precision on one core: the closed form against its analytic solution; prices
up to 1e8; 100,000 states at once; three plants under bounded disturbances and a held
control, in 10,000 runs each; and the time of a step in a compiled loop. Prints tables,
writes `benchmarks/results/safety.json`, and draws `docs/assets/safety.svg`; `--draw`
draws it again from that file.

Half of the runs meet the worst disturbance at each step, and half a random one. Decays
are chosen on 500 other runs, and so is the margin of a filter by hand: of the settings
without an exit the one of the least cost. Ours has the margin of its theorem.
"""

import functools
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import delucax as dlx
from benchmarks._results import run_in_parts
from benchmarks._safety_tasks import DISCS, Task, TASKS


RESULTS = Path(__file__).parent / "results" / "safety.json"
FIGURE = Path(__file__).parents[1] / "docs" / "assets" / "safety.svg"
LIMITS = {
    "closed form": 1e-12,
    "states": 100_000,
    "runs": 10_000,
    "cost ratio": 1.2,
    "us a step": 3.0,
}
SUBSTEPS, SECONDS = 4, 2 * np.pi
DECAYS = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0)
MARGINS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0, 3.0, 4.5)
"""What is tried by hand."""
TUNING = 500

c = dlx.controllers


class Affine(eqx.Module):
    """A barrier `rows x + level` at `x = 0`."""

    rows: jax.Array
    level: jax.Array

    def __call__(self, t, x):
        return self.rows @ x + self.level


def filtered(size: int, rows: int, **options: Any) -> Callable[..., Any]:
    """The filter of a point whose velocity is the control, as a function of its rows
    and levels and of the nominal control, in a batch."""
    plant = dlx.system(lambda t, x, u, w: u, states=size, controls=size)
    shape = (rows, size) if rows > 1 else (size,)
    given = Affine(jnp.ones(shape), jnp.zeros(shape[:-1]))
    made = c.SafetyFilter(c.Constant(np.zeros(size)), plant, given, **options)
    where = lambda s: (
        s.barriers["barrier"].rows,
        s.barriers["barrier"].level,
        s.controller.value,
    )

    @jax.jit
    @jax.vmap
    def act(rows, level, nominal):
        safe = eqx.tree_at(where, made, (rows, level, nominal))
        u, state = safe(0.0, jnp.zeros(size), safe.init())
        return u, state.failures.count

    return act


def closed_form(quick: bool) -> dict[str, Any]:
    """One condition, with and without bounds, against extended precision."""
    count, rng, rows = 500 if quick else 10_000, np.random.default_rng(0), []
    for size, bound in itertools.product((1, 2, 4), (np.inf, 1.5)):
        a, n = rng.normal(size=(2, count, size))
        level = rng.uniform(-2, 0.5, count)
        options = {} if np.isinf(bound) else dict(bounds=(-bound, bound))
        u, failed = map(np.asarray, filtered(size, 1, **options)(a, level, n))
        exact = by_halving(*(z.astype(np.longdouble) for z in (a, level, n)), bound)
        scale = np.maximum(1, np.max(np.abs(exact), 1))
        error = np.max(np.abs(u - exact), 1) / scale
        rows.append(
            {
                "controls": size,
                "bounds": None if np.isinf(bound) else bound,
                "states": count,
                "infeasible": int(failed.sum()),
                "largest error": float(error.max()),
            }
        )
    print(pd.DataFrame(rows).to_string(index=False))
    return {"rows": rows, "largest error": max(row["largest error"] for row in rows)}


def by_halving(a: Any, level: Any, n: Any, bound: float) -> Any:
    """The projections by halving the interval of the multiplier, in closed form where
    there are no bounds."""
    value = np.sum(a * n, 1) + level
    if np.isinf(bound):
        return n + (np.maximum(-value, 0) / np.sum(a * a, 1))[:, None] * a
    control = lambda push: np.clip(n + push[:, None] * a, -bound, bound)
    low = np.zeros_like(value)
    high = np.full_like(value, 1e6)
    for _ in range(150):
        middle = (low + high) / 2
        short = np.sum(a * control(middle), 1) + level < 0
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    rests = np.sum(a * control(np.zeros_like(value)), 1) + level >= 0
    return control(np.where(rests, 0, high))


def prices(quick: bool) -> dict[str, Any]:
    """Controls and derivatives that are not finite, over nine decades of the price."""
    count, rng, rows = 100 if quick else 1000, np.random.default_rng(1), []
    for conditions, price in itertools.product((1, 3), 10.0 ** np.arange(9)):
        shape = (count, conditions, 2) if conditions > 1 else (count, 2)
        a, n = rng.normal(size=shape), rng.normal(size=(count, 2))
        # Controls that are seen little, and not at all.
        a *= rng.choice([1.0, 1e-4, 1e-8, 0.0], (count, *(1,) * (a.ndim - 1)))
        level = rng.uniform(-2, 0.5, shape[:-1])
        u, failed = filtered(2, conditions, price=price)(a, level, n)
        wrong = int(np.sum(~np.isfinite(u).all(1)))
        rows.append(
            {
                "conditions": conditions,
                "price": price,
                "states": count,
                "not finite": wrong,
                "failed": int(np.sum(failed)),
            }
        )
    print(pd.DataFrame(rows).to_string(index=False))
    return {"rows": rows, "not finite": sum(row["not finite"] for row in rows)}


def at_once(quick: bool) -> dict[str, Any]:
    """The conditions of the plants at states drawn where barriers hold."""
    count, rows = 1000 if quick else LIMITS["states"], []
    for name, make in TASKS.items():
        task = make()
        safe = task.filter()
        low, high = (jnp.asarray(end) for end in task.states)
        m = task.system.control_size
        bounds = jnp.broadcast_to(task.options["bounds"][1], (m,))

        @jax.jit
        @jax.vmap
        def act(key, task=task, safe=safe, low=low, high=high, m=m, bounds=bounds):
            first, second = jax.random.split(key)
            draws = jax.random.uniform(first, (64, len(low)))
            x = low + draws * (high - low)
            fits = jax.vmap(lambda x: jnp.min(safe.conditions.values(0.0, x)) >= 0)(x)
            x = x[jnp.argmax(fits)]
            n = 1.5 * bounds * jax.random.uniform(second, (m,), minval=-1, maxval=1)
            asked = eqx.tree_at(lambda s: s.controller, safe, c.Constant(n))
            u, state = asked(0.0, x, asked.init())
            value = safe.conditions(jnp.zeros(()), x, u)
            slope = jax.jacobian(safe.conditions, 2)(jnp.zeros(()), x, u)
            size = jnp.abs(value - slope @ u) + jnp.abs(slope) @ jnp.abs(u)
            over = jnp.max(-value / size)
            return over, state.failures.count, jnp.any(u != n)

        keys = jax.random.split(jax.random.key(0), count)
        jax.block_until_ready(act(keys))
        began = time.perf_counter()
        over, failed, changed = jax.block_until_ready(act(keys))
        seconds = time.perf_counter() - began
        met = np.asarray(over)[np.asarray(failed) == 0]
        rows.append(
            {
                "plant": name,
                "states": count,
                "changed": int(np.sum(changed)),
                "infeasible": int(np.sum(failed)),
                "violated by more than 1e-9": int(np.sum(met > 1e-9)),
                "largest relative violation": float(max(met.max(), 0)),
                "us a state": 1e6 * seconds / count,
            }
        )
    print(pd.DataFrame(rows).to_string(index=False))
    return {"rows": rows}


Act = Callable[[Any, Any], tuple[Any, Any]]


def unfiltered(task: Task) -> Act:
    """The controller alone."""
    return lambda t, x: (task.controller.law(t, x), 0)


def ours(safe: Any) -> Act:
    """The filter, and how often it failed."""

    def act(t, x):
        u, state = safe(t, x, safe.init())
        return u, state.failures.count

    return act


def by_hand(task: Task, decay: Any, margin: Any) -> Act:
    """The filter in plain `jnp`."""
    return lambda t, x: (
        task.by_hand(t, x, task.controller.law(t, x), decay, margin),
        0,
    )


def one_run(task: Task, act: Act, dt: float, key: Any, is_worst: Any) -> Any:
    """States and controls at each step, the least of the barriers between, the cost and
    the failures."""
    inner = dlx.Discretized(task.system, dt / SUBSTEPS)
    low, high = task.options["bounds"]
    first, second = jax.random.split(key)
    steps, k = round(SECONDS / dt), task.system.disturbance_size
    noise = jax.random.uniform(second, (steps, k), minval=-1, maxval=1)

    def step(x, inputs):
        i, w = inputs
        t = i * dt
        w = jnp.where(is_worst, task.worst(t, x), task.options["disturbance"] * w)
        u, failed = act(t, x)
        u = jnp.clip(u, low, high)
        cost, least, before = task.cost(t, x, u), jnp.inf, x
        for j in range(SUBSTEPS):
            x, _ = inner.advance(t + j * dt / SUBSTEPS, x, u, w)
            b = task.barriers(t + (j + 1) * dt / SUBSTEPS, x)
            least = jnp.minimum(least, jnp.min(b))
        return x, (before, u, least, cost, failed)

    given = jnp.arange(steps), noise
    return jax.lax.scan(step, task.draw(first), given)[1]


@functools.cache
def many_runs(task: Task, make: Callable[..., Act], dt: float) -> Callable[..., Any]:
    """The least of the barriers, the mean cost and the failures of each of many runs,
    for numbers of a filter."""

    @eqx.filter_jit
    def run(keys, numbers):
        def one(inputs):
            key, is_worst = inputs
            act = make(task, *numbers)
            _, _, least, cost, failed = one_run(task, act, dt, key, is_worst)
            return jnp.min(least), jnp.mean(cost), jnp.sum(failed)

        return jax.lax.map(one, (keys, jnp.arange(len(keys)) % 2 == 0))

    return run


def found(task: Task, make: Any, dt: float, keys: Any, *numbers: Any) -> dict[str, Any]:
    """What many runs came to."""
    least, cost, failed = many_runs(task, make, dt)(keys, numbers)
    return {
        "runs": len(keys),
        "exits": int(np.sum(least < 0)),
        "excess": float(max(-np.min(least), 0)),
        "cost": float(np.mean(cost)),
        "failed steps": int(np.sum(failed)),
    }


def best(tried: list[tuple[Any, dict[str, Any]]]) -> Any:
    """The setting of the least cost among those without an exit or a failed step."""
    kept = [
        (row["cost"], setting)
        for setting, row in tried
        if not row["exits"] and not row["failed steps"]
    ]
    return min(kept, key=lambda pair: pair[0])[1]


def plant(name: str, quick: bool) -> dict[str, Any]:
    """Exits, excess and cost of one plant."""
    task, dt = TASKS[name](), TASKS[name]().dt
    count = 200 if quick else LIMITS["runs"]
    keys = jax.random.split(jax.random.key(1), count)
    tuning = jax.random.split(jax.random.key(2), 50 if quick else TUNING)
    alone = lambda task: unfiltered(task)
    safe_act = lambda task, safe: ours(safe)
    held = {}
    for decay in (d for d in DECAYS if d * dt <= 1):
        safe = c.SafetyFilter(
            task.controller,
            task.system,
            task.barriers,
            **(task.options | {"decay": decay}),
        )
        held[decay] = safe, safe.held(dt, task.states, times=task.times)
    decay = best([(d, found(task, safe_act, dt, tuning, held[d][1])) for d in held])
    hand = best(
        [
            (pair, found(task, by_hand, dt, tuning, *map(jnp.asarray, pair)))
            for pair in itertools.product(DECAYS, MARGINS)
        ]
    )
    bare, with_margin = held[decay]
    rows = {
        "without a filter": found(task, alone, dt, keys),
        "with the margin": found(task, safe_act, dt, keys, with_margin),
        "tuned by hand": found(task, by_hand, dt, keys, *map(jnp.asarray, hand)),
    }
    few = keys[:: max(1, count // 2000)]
    excess = {
        f"{part:g}": found(task, safe_act, part * dt, few, bare)["excess"]
        for part in (1.0, 0.5, 0.25)
    }
    halved = [excess["0.5"] / excess["1"], excess["0.25"] / excess["0.5"]]
    print(f"\n{name}: decay {decay}, margin {with_margin.margin}, by hand {hand}")
    print(pd.DataFrame(rows).T.to_string())
    print("without the margin, excess by dt:", excess, halved)
    paths = {}
    for label, act in (("unsafe", unfiltered(task)), ("safe", ours(with_margin))):
        states, *_ = one_run(task, act, dt, keys[0], jnp.array(True))
        paths[label] = np.asarray(states)[::2].round(4).tolist()
    return {
        "dt": dt,
        "decay": decay,
        "margin": np.asarray(with_margin.margin).tolist(),
        "by hand": {"decay": hand[0], "margin": hand[1]},
        "rows": rows,
        "left without a filter": rows["without a filter"]["exits"] / count,
        "cost ratio": rows["with the margin"]["cost"] / rows["tuned by hand"]["cost"],
        "excess without the margin": excess,
        "excess halves to": halved,
        "paths": paths,
    }


def speed(quick: bool) -> dict[str, Any]:
    """A step of a closed loop in a scan, with nothing subtracted."""
    rounds, steps, rows = 3 if quick else 15, 20_000, []
    for name in ("double integrator", "pendulum"):
        task = TASKS[name]()
        safe = task.margin()
        acts = {
            "no filter": unfiltered(task),
            "by hand": by_hand(task, 3.0, 0.2),
            "filter": ours(safe),
        }
        loops = {label: loop_of(task, act, steps) for label, act in acts.items()}
        environment = dlx.Environment(
            dlx.Discretized(task.system, task.dt),
            dlx.costs.Function(task.cost),
            initial_state=task.draw(jax.random.key(0)),
        )
        rollout = jax.jit(
            lambda key, e=environment, s=safe: (
                dlx.rollout(e, s, key=key, horizon=steps).final_state
            )
        )
        loops["filter, in rollout"] = lambda r=rollout: r(jax.random.key(0))
        seconds: dict[str, list[float]] = {label: [] for label in loops}
        for _ in range(rounds + 1):
            for label, run in loops.items():
                began = time.perf_counter()
                jax.block_until_ready(run())
                seconds[label].append(time.perf_counter() - began)
        # The first round compiles.
        us = {label: 1e6 * min(s[1:]) / steps for label, s in seconds.items()}
        rows.append({"plant": name} | us)
    print(pd.DataFrame(rows).to_string(index=False))
    return {"rows": rows}


def loop_of(task: Task, act: Act, steps: int) -> Callable[[], Any]:
    """A closed loop of many steps, that returns its states and failures."""
    dynamics = dlx.Discretized(task.system, task.dt)
    none = jnp.zeros(task.system.disturbance_size)

    def step(x, k):
        t = k * task.dt
        u, failed = act(t, x)
        return dynamics.advance(t, x, u, none)[0], (x, failed)

    run = jax.jit(lambda x: jax.lax.scan(step, x, jnp.arange(steps))[1])
    start = task.draw(jax.random.key(0))
    return lambda: run(start)


def draw(content: dict[str, Any]) -> None:
    """One run of each plant, under the worst disturbance."""
    import matplotlib.pyplot as plt

    plt.style.use("delucax.plotting.style")
    figure, axes = plt.subplots(1, 3, figsize=(9.5, 3.2), layout="constrained")
    styles = {"unsafe": ("C1", "without"), "safe": ("C0", "with the filter")}
    for ax, name in zip(axes, TASKS, strict=True):
        shown = content[name]
        times = 2 * shown["dt"] * np.arange(len(shown["paths"]["safe"]))
        for label, (colour, words) in styles.items():
            x = np.array(shown["paths"][label])
            if name == "unicycle":
                point = x[:, :2] + 0.15 * np.stack(
                    [np.cos(x[:, 2]), np.sin(x[:, 2])], 1
                )
                ax.plot(*point.T, color=colour, lw=1.4, label=words)
            else:
                column = 0 if name == "double integrator" else 1
                ax.plot(times, x[:, column], color=colour, lw=1.4, label=words)
        ax.set_title(name)
        if name == "unicycle":
            for x, y, radius in np.asarray(DISCS):
                ax.add_patch(plt.Circle((x, y), radius, color="0.85", lw=0))
            ax.set(aspect="equal", xlabel="x, m", ylabel="y, m")
        elif name == "pendulum":
            ax.fill_between(times, 4, 5.5, color="0.85", lw=0)
            ax.set(xlabel="time, s", ylabel="speed, rad/s", ylim=(None, 5.5))
        else:
            wall = 1 + 0.2 * np.sin(2 * times)
            ax.fill_between(times, wall, 1.6, color="0.85", lw=0)
            ax.set(xlabel="time, s", ylabel="position, m", ylim=(None, 1.6))
    handles = axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=2)
    figure.savefig(FIGURE, metadata={"Date": None})


PARTS: dict[str, Callable[[bool], Any]] = {
    "closed form": closed_form,
    "prices": prices,
    "at once": at_once,
    "speed": speed,
    **{name: functools.partial(plant, name) for name in TASKS},
}


if __name__ == "__main__":
    run_in_parts("safety", PARTS, {"limits": LIMITS}, RESULTS, draw)
