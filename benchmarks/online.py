"""`python -m benchmarks.online`: what online learners cost, and what they reach.

Speed in single precision; then, in double precision, the double integrator at the
defaults, 20 plants at random, the values that were published for GPC, DRC and AdaGPC,
and the plant that switches. Prints tables, and writes `benchmarks/results/online.json`,
and the speed pinned to one core in `pinned/`.

The limits were written before the first run. The learners have their defaults unless a
row says otherwise; nothing was tuned on these seeds and plants.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pandas as pd
from jaxtyping import Array

import delucax as dlx
from benchmarks._machine import compile_anew, describe, run_in_settings
from benchmarks._timing import compiled, race


LIMITS = {
    "GPC, us a step": 3.0,
    "AdaGPC, us a step": 10.0,
    "600 steps of AdaGPC with compilation, s": 1.0,
    "GPC, 256 seeds: times faster a run": 20.0,
    "Gaussian: GPC / LQR": 1.05,
    "slow sine: GPC / LQR": 0.15,
    "constant: GPC / LQR": 0.15,
    "GPC / hindsight": 1.5,
    "random plants: median GPC / hindsight": 1.5,
    "published value": 1.05,
    "AdaGPC / GPC, switch": 0.92,
    "AdaGPC / GPC, no switch": 1.02,
}
"""At most these, and at least for "times faster"."""
ORIGINAL = {"GPC": "4400 to 5300", "AdaGPC": "180000"}
"""Microseconds a step that the notebooks of the original Deluca show."""
SEEDS = 20
PARTS = ("speed", "defaults", "random plants", "published", "switching")

c = dlx.controllers
A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.0], [1.0]])


def env_of(dynamics: Any, scale: float = 1.0) -> dlx.Environment:
    """A plant with the sum of squares of state and control as cost."""
    Q, R = np.eye(dynamics.state_size), np.eye(dynamics.control_size)
    return dlx.Environment(dynamics, dlx.costs.Quadratic(scale * Q, scale * R))


def rolled(env: dlx.Environment, controller: Any, w: Array, key: Any = 0) -> Any:
    """The costs of one run from rest."""
    x0 = jnp.zeros(env.state_size)
    options: Any = dict(key=jr.key(key), x0=x0, horizon=len(w), throw=False)
    return dlx.rollout(env, controller, w=w, keep=("costs",), **options).costs


@jax.jit
def costs(env: dlx.Environment, controller: Any, w: Array) -> Array:
    """Of each lane of disturbances, at each step."""
    return jax.vmap(lambda w: rolled(env, controller, w))(w)


def means(env: dlx.Environment, controller: Any, w: Array) -> np.ndarray:
    """The average cost of each lane."""
    return np.asarray(costs(env, controller, w)).mean(axis=1)


class Table:
    """Rows with what was measured, and the limit beside it."""

    def __init__(self):
        self.rows: list[dict[str, Any]] = []

    def add(self, what: str, value: float, limit: str | float | None = None) -> None:
        """One row; `limit` is a number or the name of one in `LIMITS`."""
        least = isinstance(limit, str) and limit.endswith("faster a run")
        limit = LIMITS[limit] if isinstance(limit, str) else limit
        row: dict[str, Any] = {"what": what, "measured": float(value), "limit": limit}
        if limit is not None:
            row["ok"] = bool(value >= limit if least else value <= limit)
        self.rows.append(row)

    def show(self, title: str) -> None:
        """Print it."""
        print(f"\n{title}")
        table = pd.DataFrame(self.rows)
        print(table.to_string(index=False, float_format="%.4g", na_rep=""), flush=True)


def speed(rounds: int) -> tuple[Table, list[dict[str, Any]]]:
    """Single precision, the double integrator, memory 10 and roll-out 10."""
    env = env_of(dlx.LinearDynamics(A, B))
    learner = c.gpc(env.dynamics, env.cost, memory=10, horizon=10)
    contenders = {
        "LQR": c.LQR(env.dynamics, np.eye(2), np.eye(1)),
        "GPC": learner,
        "DRC": c.drc(env.dynamics, env.cost, memory=10, horizon=10),
        "SFC": c.sfc(env.dynamics, env.cost, horizon=10),
        "BPC": c.BPC(env.dynamics, learner.loop.base),
        "AdaGPC": c.Adaptive(learner, slots=8),
    }
    w = jr.normal(jr.key(1), (20_000, 2))
    many = jr.normal(jr.key(2), (256, 1000, 2))

    def total(controller, w):
        return jnp.sum(rolled(env, controller, w))

    runs = [compiled(n, len(w), total, k, w) for n, k in contenders.items()]
    batch = jax.vmap(total, (None, 0))
    for name in ("LQR", "GPC", "AdaGPC"):
        label = f"{name}, 256 lanes"
        runs.append(compiled(label, 256_000, batch, contenders[name], many))
    timed = {timing.name: timing for timing in race(runs, rounds=rounds)}
    rows = [timing.row() for timing in timed.values()]
    for row in rows:
        row["original us/step"] = ORIGINAL.get(row["contender"], "")
    print(pd.DataFrame(rows).to_string(index=False, float_format="%.4g", na_rep=""))

    def first():
        jax.clear_caches()
        adaptive, short = contenders["AdaGPC"], w[:600]
        start, cpu = time.perf_counter(), time.process_time()
        jax.jit(total)(adaptive, short).block_until_ready()
        return time.perf_counter() - start, time.process_time() - cpu

    wall, cpu = np.min([first() for _ in range(5)], axis=0)
    table = Table()
    for name in ("GPC", "AdaGPC"):
        # The fastest round: others slow down the rest, not the program.
        what = f"{name}, us a step"
        table.add(what, timed[name].best / 1e3, what)
    limit = "600 steps of AdaGPC with compilation, s"
    table.add(limit, wall, limit)
    table.add("the same, seconds of the processor", cpu)
    for name in ("GPC", "AdaGPC", "LQR"):
        faster = timed[name].best / timed[f"{name}, 256 lanes"].best
        what = "GPC, 256 seeds: times faster a run"
        table.add(what.replace("GPC", name), faster, what if name == "GPC" else None)
    table.show("Speed (the original took 108 s for 600 steps of AdaGPC)")
    return table, rows


def least(dynamics: Any, K: np.ndarray, w: np.ndarray, memory: int = 10) -> float:
    """The average cost of the best disturbance-action policy, by least squares."""
    A, B = np.asarray(dynamics.A), np.asarray(dynamics.B)
    n, m = B.shape
    loop, x = A - B @ K, np.zeros(n)
    S, past = np.zeros((n, m, memory * n)), np.zeros(memory * n)
    rows, right = [], []
    for now in w:
        added = -np.einsum("mn,nkp->mkp", K, S)
        added[range(m), range(m)] += past
        rows += [S.reshape(n, -1), added.reshape(m, -1)]
        right += [x, -K @ x]
        S = np.einsum("ij,jkp->ikp", loop, S) + np.einsum("ik,p->ikp", B, past)
        x, past = loop @ x + now, np.concatenate([now, past[:-n]])
    rows, right = np.concatenate(rows), np.concatenate(right)
    theta = np.linalg.lstsq(rows, -right, rcond=None)[0]
    return float(np.sum((rows @ theta + right) ** 2) / len(w))


def kinds(seeds: int, steps: int, size: int, seed: int) -> dict[str, np.ndarray]:
    """Unit Gaussian noise, a slow sine and a constant push."""
    ones = np.ones((seeds, steps, size))
    slow = np.sin(np.arange(steps) / (2 * np.pi))[:, None] * ones
    noise = np.random.default_rng(seed).normal(size=ones.shape)
    return {"Gaussian": noise, "slow sine": slow, "constant": ones}


def defaults(seeds: int) -> tuple[Table, list[dict[str, Any]]]:
    """The double integrator from rest, 1000 steps, in three scales."""
    table, rows = Table(), []
    for name, w in kinds(seeds, 1000, 2, 100).items():
        for scale in (1.0, 1e-2, 1e2):
            env = env_of(dlx.LinearDynamics(A, B), scale)
            learner = c.gpc(env.dynamics, env.cost)
            base = learner.loop.base
            unit = scale**3
            size = jnp.asarray(scale * w)
            here = {
                "GPC": means(env, learner, size) / unit,
                "LQR": means(env, base, size) / unit,
                "zero": means(env, c.Zero(1), size) / unit,
            }
            best = [least(env.dynamics, np.asarray(base.K), one) for one in w]
            here["hindsight"] = np.array(best)
            row = {"disturbance": name, "scale": scale}
            rows.append(row | {k: float(v.mean()) for k, v in here.items()})
            label = f"{name}, scale {scale:g}: GPC / "
            ratio = here["GPC"].mean() / here["LQR"].mean()
            table.add(label + "LQR", ratio, f"{name}: GPC / LQR")
            ratio = here["GPC"].mean() / here["hindsight"].mean()
            table.add(label + "hindsight", ratio, "GPC / hindsight")
    w = jnp.asarray(kinds(1, 1000, 2, 100)["Gaussian"][0])
    env = env_of(dlx.LinearDynamics(A, B))
    learner = c.gpc(env.dynamics, env.cost)
    options: Any = dict(key=jr.key(0), x0=jnp.zeros(2), horizon=1000, w=w)
    run = dlx.rollout(env, learner, **options)
    found = c.best_in_hindsight(env, learner.fixed(), run).trajectory.total_cost / 1000
    exact = least(env.dynamics, np.asarray(learner.loop.base.K), np.asarray(w))
    table.add("best_in_hindsight / least squares - 1", abs(found / exact - 1), 1e-8)
    print("\nAverage costs, double integrator, 1000 steps from rest")
    print(pd.DataFrame(rows).to_string(index=False, float_format="%.4g"))
    table.show("GPC at its defaults")
    return table, rows


def random_plants(count: int) -> tuple[Table, list[dict[str, Any]]]:
    """Plants of 2 to 5 states and 1 or 2 controls, some of them unstable."""
    rng = np.random.default_rng(20_260_000)
    rows = []
    for index in range(count):
        n, m = int(rng.integers(2, 6)), int(rng.integers(1, 3))
        A, radius = rng.normal(size=(n, n)), rng.uniform(0.7, 1.15)
        A *= radius / np.max(np.abs(np.linalg.eigvals(A)))
        B = rng.normal(size=(n, m)) * np.exp(rng.uniform(-1, 1))
        env = env_of(dlx.LinearDynamics(A, B))
        learner = c.gpc(env.dynamics, env.cost)
        K = np.asarray(learner.loop.base.K)
        row = {"n": n, "m": m, "radius": radius, "roll-out": learner.loop.horizon}
        for name, w in kinds(1, 1000, n, 500 + index).items():
            best = least(env.dynamics, K, w[0])
            row[name] = means(env, learner, jnp.asarray(w))[0] / best
            row[f"{name}, LQR"] = (
                means(env, learner.loop.base, jnp.asarray(w))[0] / best
            )
        rows.append(row)
    print("\nAverage cost over that of hindsight, random plants, 1000 steps")
    frame = pd.DataFrame(rows)
    print(frame.to_string(index=False, float_format="%.3f"))
    table = Table()
    names = ["Gaussian", "slow sine", "constant"]
    limit = "random plants: median GPC / hindsight"
    for name in names:
        table.add(f"{name}: median GPC / hindsight", frame[name].median(), limit)
        table.add(f"{name}: worst GPC / hindsight", frame[name].max())
        table.add(f"{name}: median LQR / hindsight", frame[f"{name}, LQR"].median())
    table.add("all three: median GPC / hindsight", np.median(frame[names]), limit)
    table.show("Random plants")
    return table, rows


def fading(rate: Any) -> Any:
    """Gradient descent with a step that falls as the square root of the age."""
    schedule = optax.scale_by_schedule(lambda k: 1 / jnp.sqrt(k + 1.0))
    descent = optax.chain(schedule, optax.scale(-1.0))
    return dict(horizon=10, learning_rate=rate, optimiser=descent)


def published(seeds: int) -> tuple[Table, list[dict[str, Any]]]:
    """What GPC and DRC reached in the settings that were published for them."""
    table = Table()
    env = env_of(dlx.LinearDynamics(A, B))
    learner = c.gpc(env.dynamics, env.cost, **fading(0.005))
    base = learner.loop.base
    values = {"Gaussian": 1.027, "slow sine": 0.091, "constant": 0.073}
    for name, w in kinds(seeds, 1000, 2, 200).items():
        w = jnp.asarray(w)
        ratio = means(env, learner, w).mean() / means(env, base, w).mean()
        limit = LIMITS["published value"] * values[name]
        table.add(f"GPC / LQR, {name} ({values[name]})", ratio, limit)
    C = np.array([[1.0, 0.0]])
    plant = dlx.LinearDynamics(np.array([[0.9, 0.5], [0.0, 0.9]]), B, C)
    one = np.eye(1)
    env = dlx.Environment(plant, dlx.costs.Quadratic(C.T @ C, one))
    adam = optax.chain(optax.scale_by_adam(), optax.scale(-1.0))
    cost = dlx.costs.Quadratic(one, one)
    options: Any = dict(horizon=40, learning_rate=1e-3, optimiser=adam, radius=10.0)
    alone = c.drc(plant, cost, base=c.Zero(1), **options)
    observer = c.LQG(plant, C.T @ C, one, np.eye(2), 0.01 * one)
    others = {
        "LQG": observer,
        "DRC on LQG": c.drc(plant, cost, base=observer),
        "zero": c.Zero(1),
    }
    values = {"slow sine": (2.44, 0.362), "constant": (5.26, 2.61)}
    for name, w in kinds(seeds, 2000, 2, 300).items():
        w = jnp.asarray(0.3 * w)
        half = lambda k, w=w: np.asarray(costs(env, k, w))[:, 1000:].mean()  # noqa: E731
        known = values.get(name, (0.90, 4.4))
        limit = LIMITS["published value"] * known[1]
        table.add(f"DRC alone, {name} ({known[1]})", half(alone), limit)
        for label, controller in others.items():
            noted = f" ({known[0]})" if label == "LQG" else ""
            table.add(f"{label}, {name}{noted}", half(controller))
    table.show("Published values in brackets (averages of the second half for DRC)")
    return table, []


class Restarted(dlx.AbstractController):
    """A learner that forgets at a given step; it has to be told when."""

    base: dlx.AbstractLearner
    at: Array = dlx.parameter()

    def init(self, *, key=None):
        return self.base.init(key=key), jnp.zeros(())

    def __call__(self, t, y, state):
        inner, step = state
        fresh = self.base.fresh(inner, None)
        inner = jax.tree.map(
            lambda a, b: jnp.where(step == self.at, a, b), fresh, inner
        )
        u, inner = self.base(t, y, inner)
        return u, (inner, step + 1)

    def applied(self, u, cost, state):
        return self.base.applied(u, cost, state[0]), state[1]


def switching(seeds: int) -> tuple[Table, list[dict[str, Any]]]:
    """The plant becomes another halfway through 600 steps."""
    late = np.arange(600)[:, None, None] >= 300
    first = np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([[0.0], [1.2]])
    second = np.array([[1.0, 1.5], [0.0, 1.0]]), np.array([[0.0], [0.9]])
    switched = [np.where(late, b, a) for a, b in zip(first, second, strict=True)]
    t = np.arange(600)[:, None]
    noise = 0.2 * np.random.default_rng(400).normal(size=(seeds, 600, 2))
    blocks = np.where((t // 150) % 2 == 0, noise, 0.4 * np.sin(t))
    table, rows = Table(), []
    for change, plant in {"switch": switched, "no switch": first}.items():
        env = env_of(dlx.LinearDynamics(*plant))
        cost = env.cost
        for setting, options in {
            "published step": fading(0.005),
            "defaults": {},
        }.items():
            learner = c.gpc(env.dynamics, cost, **options)
            stale = c.gpc(dlx.LinearDynamics(*first), cost, **options)
            steady: Any = dict(optimiser=optax.scale(-1.0), learning_rate=0.005)
            tried = {
                "LQR": learner.loop.base,
                "GPC, stale model": stale,
                "GPC": learner,
                "GPC, constant step": c.gpc(env.dynamics, cost, **steady),
                "GPC, restarted": Restarted(learner, 300.0),
                "AdaGPC": c.Adaptive(learner),
                "AdaGPC, switching play": c.Adaptive(learner, play="switch"),
            }
            for name, w in {"blocks": blocks, "Gaussian": noise}.items():
                found = {k: means(env, v, jnp.asarray(w)) for k, v in tried.items()}
                row = {"plant": change, "disturbance": name, "step": setting}
                rows.append(row | {k: float(v.mean()) for k, v in found.items()})
                gap = found["AdaGPC"] - found["GPC"]
                half = 1.96 * gap.std(ddof=1) / np.sqrt(seeds)
                what = f"{change}, {name}, {setting}: AdaGPC / GPC"
                ratio = found["AdaGPC"].mean() / found["GPC"].mean()
                counts = change == "no switch" or name == "blocks"
                table.add(what, ratio, f"AdaGPC / GPC, {change}" if counts else None)
                if change == "switch" and name == "blocks":
                    table.add(f"{what}, difference at most", gap.mean() + half, 0.0)
                    for other in ("GPC, restarted", "GPC, constant step"):
                        ratio = found["AdaGPC"].mean() / found[other].mean()
                        table.add(what.replace("/ GPC", f"/ {other}"), ratio)
    print(
        "\nAverage costs, 600 steps (published, blocks: LQR .767, stale .655, GPC .515,"
    )
    print("AdaGPC .450; Gaussian: .3271, .551, .3270, .3271)")
    print(pd.DataFrame(rows).to_string(index=False, float_format="%.4f"))
    table.show("Switching plants")
    return table, rows


def measure(options: argparse.Namespace, folder: Path) -> None:
    """Measure, print and write."""
    out = folder / "online.json"
    compile_anew()
    quick = options.quick
    seeds = 4 if quick else SEEDS
    # Speed first, for it is in single precision.
    parts: dict[str, Any] = {
        "speed": lambda: speed(3 if quick else 15),
        "defaults": lambda: defaults(seeds),
        "random plants": lambda: random_plants(3 if quick else 20),
        "published": lambda: published(seeds),
        "switching": lambda: switching(seeds),
    }
    content: dict[str, Any] = {"seeds": seeds, "limits": LIMITS}
    if options.part is not None:
        content = json.loads(out.read_text()) if out.exists() else content
        parts = {options.part: parts[options.part]}
    elif folder.name == "pinned":
        parts = {"speed": parts["speed"]}
    for name, part in parts.items():
        jax.config.update("jax_enable_x64", name != "speed")
        table, rows = part()
        checks = {"checks": table.rows, "rows": rows}
        content[name] = {"machine": describe()} | checks
    if not quick:
        out.write_text(json.dumps(content, indent=1) + "\n")
        print(f"\nwritten: {out}")


def main() -> None:
    """Run under both settings; the costs of the learners are those of the first."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.online")
    parser.add_argument("--quick", action="store_true", help="small sizes, no file")
    parser.add_argument("--part", choices=PARTS, help="one table alone, again")
    run_in_settings(parser, measure)


if __name__ == "__main__":
    main()
