"""`python -m benchmarks.estimation`: moving-horizon estimation.

In double precision: the distance of `estimators.MHE` from the Kalman filter on linear
dynamics; the gas-phase reactor of Haseltine and Rawlings (2005), whose extended Kalman
filter fails; a parameter that drifts; outliers; and the time of an update and a
prediction. Prints tables, and writes `benchmarks/results/estimation.json`, and the same
pinned to one core in `pinned/`. With the defaults it draws
`docs/assets/estimation.svg`; `--draw` draws it again from the results.

The limits were written down before the first run. Of the reactor an estimate has
converged if it is within 0.1 of both pressures over the last 5 s of 15.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array

import delucax as dlx
from benchmarks._machine import compile_anew, describe, FOLDERS, run_in_settings


LIMITS = {
    "distance from the Kalman filter": 1e-9,
    "step of a window of 20, n = 4, median ms": 1.0,
}
FIGURE = Path(__file__).parents[1] / "docs" / "assets" / "estimation.svg"
WINDOWS = 1, 2, 5, 20
ROUNDS = 8
START = np.array([0.0, 0.1, 0.0, 0.0])
CLOSE = 0.1
e = dlx.estimators


class Reactor(dlx.AbstractSystem):
    """2 A -> B in the gas phase, of which the total pressure is seen."""

    state_names: ClassVar = ("A", "B")
    control_names: ClassVar = ()
    k: Array = dlx.parameter(0.16)

    def vector_field(self, t, x, u, w):
        rate = self.k * x[0] ** 2
        return jnp.stack([-2 * rate, rate])

    def observe(self, t, x):
        return jnp.sum(x, keepdims=True)


def linear_case(rng: Any, rank: int) -> tuple[Any, Any, Any, Any, Any]:
    """Stable dynamics with covariances of a rank, and a record of 60 steps."""
    n, k, p, T = 4, 3, 2, 60
    A = rng.normal(size=(n, n))
    A /= 1.05 * np.max(np.abs(np.linalg.eigvals(A)))
    B, C, E = (rng.normal(size=shape) for shape in ((n, 1), (p, n), (n, k)))
    sizes = (k, 2 * rank), (p, rank), (n, 2 * rank)
    roots = [rng.normal(size=(size, min(size, most))) for size, most in sizes]
    draw = lambda root: root @ rng.normal(size=root.shape[1])
    x, us, ys = draw(roots[2]), rng.normal(size=(T, 1)), []
    for u in us:
        ys.append(C @ x + draw(roots[1]))
        x = A @ x + B @ u + E @ draw(roots[0])
    W, V, P = (root @ root.T for root in roots)
    return dlx.LinearDynamics(A, B, C, E), (W, V), P, np.array(ys), us


def distances() -> list[dict[str, Any]]:
    """The largest difference of a mean or a covariance, over 5 systems."""
    rows = []
    for window in WINDOWS:
        row: dict[str, Any] = {"window": window}
        for name, rank in (("definite", 2), ("singular", 1)):
            worst = 0.0
            for seed in range(5):
                case = linear_case(np.random.default_rng(seed), rank)
                dynamics, noise, P, ys, us = case
                prior = dict(mean=np.zeros(4), covariance=P)
                kalman = e.KalmanFilter(dynamics, *noise, **prior)
                expected = e.run_filter(kalman, ys, us, throw=False)
                mhe = e.MHE(dynamics, *noise, window, **prior)
                found = e.run_estimator(mhe, ys, us)
                pairs = zip(
                    jax.tree.leaves((found.updated, found.predicted)),
                    jax.tree.leaves((expected.updated, expected.predicted)),
                    strict=True,
                )
                off = max(float(jnp.max(jnp.abs(a - b))) for a, b in pairs)
                worst = max(worst, off)
            row[name] = worst
        rows.append(row)
    return rows


def reactor(records: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Estimators of the reactor on paired records, and the record on which the late
    error of the first estimator is the median."""
    dynamics = dlx.Discretized(Reactor(), dt=0.1)
    T, late = 150, slice(100, None)
    rng = np.random.default_rng(0)
    w = 1e-3 * rng.normal(size=(records, T, 2))
    v = 0.1 * rng.normal(size=(records, T, 1))
    run = lambda w: dlx.open_loop(dynamics, jnp.array([3.0, 1.0]), jnp.zeros((T, 0)), w)
    states = jax.vmap(run)(jnp.array(w))[:, :-1]
    ys = jnp.sum(states, axis=2, keepdims=True) + v
    noise = 1e-6 * np.eye(2), 1e-2 * np.eye(1)
    prior = dict(mean=[0.1, 4.5], covariance=36 * np.eye(2))
    positive = dict(bounds=(0.0, jnp.inf))
    cases: dict[str, Any] = {
        "extended Kalman filter": e.ExtendedKalmanFilter(dynamics, *noise, **prior),
        "unscented Kalman filter": e.UnscentedKalmanFilter(dynamics, *noise, **prior),
        "MHE, 20, no bounds": e.MHE(dynamics, *noise, 20, **prior),
    }
    for window in (5, 10, 20):
        name = f"MHE, {window}, positive"
        cases[name] = e.MHE(dynamics, *noise, window, **prior, **positive)
    rows: list[dict[str, Any]] = []
    shown: dict[str, Any] = {}
    typical = None
    for name, estimator in cases.items():
        along = jax.jit(jax.vmap(lambda y, c=estimator: mean_of(c, y)))
        mean, ok = along(ys)
        off = jnp.max(jnp.abs(mean - states)[:, late], axis=(1, 2))
        rows.append(
            {
                "estimator": name,
                "records": records,
                "negative": int(jnp.sum(jnp.min(mean, axis=(1, 2)) < 0)),
                "least pressure": float(jnp.min(mean)),
                "converged": int(jnp.sum(off <= CLOSE)),
                "median of the largest late error": float(jnp.median(off)),
                "failed updates": int(jnp.sum(~ok)),
            }
        )
        if typical is None:
            typical = int(jnp.argsort(off)[records // 2])
            shown["states"] = states[typical].tolist()
        shown[name] = mean[typical].tolist()
    return rows, shown


def mean_of(estimator: Any, y: Array, u: Any = None) -> tuple[Array, Array]:
    """The estimates along a record, and which updates succeeded."""
    found = e.run_estimator(estimator, y, u, throw=False)
    return found.updated.mean, found.results == dlx.RESULTS.successful


def drift() -> dict[str, float]:
    """The length of a pendulum that changes by 30% and back in 12 s, between 0.7 and
    1.3 m, from a guess of 1.2 m."""
    rng, T = np.random.default_rng(0), 240
    lengths = 1.0 + 0.3 * np.sin(2 * np.pi * np.arange(T) / T)
    us = 4 * np.sin(0.4 * np.arange(T))[:, None]
    swing = lambda length: dlx.Discretized(dlx.systems.Pendulum(length=length), dt=0.05)

    @jax.jit
    def swung(lengths, us):
        def step(x, inputs):
            return swing(inputs[0])(0.0, x, inputs[1]), x

        return jax.lax.scan(step, jnp.array([0.5, 0.0]), (lengths, us))[1]

    ys = swung(lengths, us) + 0.01 * rng.normal(size=(T, 2))
    walk = {"system.length": e.RandomWalk(0.04, step=1e-4)}
    weights = 1e-8 * np.eye(2), 1e-4 * np.eye(2)
    options = dict(covariance=0.1 * np.eye(2), parameters=walk)
    mhe = e.MHE(swing(1.2), *weights, 15, **options)
    found = e.run_estimator(mhe, ys, us)
    beliefs = jax.vmap(mhe.estimated_parameters)(found.states)["system.length"]
    off = np.abs(beliefs.mean[:, 0] - lengths)[60:]
    spread = np.sqrt(beliefs.covariance[60:, 0, 0])
    return {
        "mean error, m": float(np.mean(off)),
        "largest error, m": float(np.max(off)),
        "mean standard deviation, m": float(np.mean(spread)),
    }


def outliers(records: int) -> list[dict[str, Any]]:
    """A tenth of the readings of an oscillator is wrong by 30 standard deviations."""
    A = np.array([[1.0, 0.1], [-0.1, 0.98]])
    dynamics = dlx.LinearDynamics(A, np.zeros((2, 1)), np.array([[1.0, 0.0]]))
    T, rng = 100, np.random.default_rng(0)
    w = 0.01 * rng.normal(size=(records, T, 2))
    run = lambda w: dlx.open_loop(dynamics, jnp.array([1.0, 0.0]), jnp.zeros((T, 1)), w)
    states = jax.vmap(run)(jnp.array(w))[:, :-1]
    wrong = 3.0 * (rng.random(size=(records, T, 1)) < 0.1)
    noise = 0.1 * rng.normal(size=(records, T, 1))
    weights = 1e-4 * np.eye(2), 1e-2 * np.eye(1)
    rows = []
    for robust in (None, 2.0):
        mhe = e.MHE(dynamics, *weights, 10, robust=robust)
        along = jax.jit(jax.vmap(lambda y, mhe=mhe: mean_of(mhe, y)[0]))
        row: dict[str, Any] = {"robust": "none" if robust is None else f"{robust:g}"}
        for name, seen in (("clean", noise), ("with outliers", noise + wrong)):
            off = (along(states[:, :, :1] + seen) - states)[:, 10:, 0]
            row[name] = float(jnp.sqrt(jnp.mean(off**2)))
        rows.append(row)
    return rows


def steps(count: int) -> list[dict[str, Any]]:
    """An update and a prediction of a cart-pole that is seen with noise, window 20, in
    the calmest of the rounds."""
    dynamics = dlx.Discretized(dlx.systems.CartPole(), dt=0.05)
    weights = 1e-4 * np.eye(4), 1e-2 * np.eye(4)
    far, near = np.full(4, 1e3), np.array([0.02, 1e3, 1e3, 1e3])
    cases: dict[str, dict[str, Any]] = {
        "no bounds": {},
        "robust": dict(robust=2.0),
        "bounds, none active": dict(bounds=(-far, far)),
        "bounds, active": dict(bounds=(-near, near)),
    }
    plant = jax.jit(lambda x, u: dynamics(0.0, x, u))
    rows = []
    for name, options in cases.items():
        mhe = e.MHE(dynamics, *weights, 20, **options)
        took, held, began = [], 0, time.perf_counter()
        given = 0.0, np.zeros(4), np.zeros(1), mhe.init()
        call: Callable[..., Any] = (
            jax.jit(lambda *given, mhe=mhe: step(mhe, *given)).lower(*given).compile()
        )
        seconds = time.perf_counter() - began
        rng = np.random.default_rng(0)
        x, state = START, mhe.init()
        ok = True
        for k in range(ROUNDS * count):
            u = np.array([0.5 * np.sin(0.1 * k)])
            y = np.asarray(x) + 0.1 * rng.normal(size=4)
            began = time.perf_counter()
            _, state, sides, good = jax.block_until_ready(call(0.0, y, u, state))
            took.append(time.perf_counter() - began)
            held += int(np.any(sides != 0))
            ok = ok and bool(good)
            # Not far from the start, as nothing holds the pole.
            x = plant(x, u) if k % 40 else START
        rounds = 1e3 * np.array(took).reshape(ROUNDS, count)
        best = rounds[np.argmin(np.percentile(rounds, 99, axis=1))]
        rows.append(
            {
                "case": name,
                "median ms": float(np.median(best)),
                "p99 ms": float(np.percentile(best, 99)),
                "median ms, all rounds": float(np.median(rounds)),
                "steps": count,
                "share with an active bound": held / rounds.size,
                "all succeeded": ok,
                "compilation, s": seconds,
            }
        )
    return rows


def step(mhe: Any, t: Any, y: Any, u: Any, state: Any) -> Any:
    """What a controller asks for in a step."""
    after = mhe.update(t, y, state)
    good = mhe.status(after) == dlx.RESULTS.successful
    return mhe.estimate(after).mean, mhe.predict(t, u, after), after.sides, good


def draw(content: dict[str, Any]) -> None:
    """The typical record of the reactor."""
    import matplotlib.pyplot as plt

    shown = content["typical record"]
    states, t = np.array(shown["states"]), 0.1 * np.arange(len(shown["states"]))
    plt.style.use("delucax.plotting.style")
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    lines = {
        "extended Kalman filter": "extended Kalman filter",
        "MHE, 20, no bounds": "moving horizon, no bounds",
        "MHE, 20, positive": "moving horizon, positive",
    }
    for i, ax in enumerate(axes):
        ax.plot(t, states[:, i], "k:", lw=1.6, label="truth")
        for name, label in lines.items():
            ax.plot(t, np.array(shown[name])[:, i], lw=1.2, label=label)
        ax.axhspan(-5, 0, color="0.93", lw=0)
        title = f"partial pressure of {'AB'[i]}"
        ax.set(
            title=title, xlabel="time", xlim=(0, t[-1]), ylim=((-4.5, 4), (-0.5, 9))[i]
        )
    axes[1].legend(fontsize=8)
    figure.savefig(FIGURE, metadata={"Date": None})


def measure(options: argparse.Namespace, folder: Path) -> None:
    """All tables under one setting."""
    jax.config.update("jax_enable_x64", True)
    compile_anew()
    path, began = folder / "estimation.json", time.perf_counter()
    if options.draw:
        if folder == FOLDERS["defaults"]:
            draw(json.loads(path.read_text()))
        return
    content: dict[str, Any] = {"machine": describe(), "limits": LIMITS}
    parts: dict[str, Callable[[], Any]] = {
        "steps": lambda: steps(options.steps),
        "distances": distances,
        "reactor": lambda: reactor(options.records),
        "drift": drift,
        "outliers": lambda: outliers(options.records),
    }
    for name, part in parts.items():
        content[name] = part()
        if name == "reactor":
            content[name], content["typical record"] = content[name]
        rows = content[name] if isinstance(content[name], list) else [content[name]]
        print(f"\n{name}\n{pd.DataFrame(rows).to_string(index=False)}", flush=True)
    content["distance, most"] = max(
        row[kind] for row in content["distances"] for kind in ("definite", "singular")
    )
    content["seconds"] = time.perf_counter() - began
    path.write_text(json.dumps(content, indent=1) + "\n")
    if folder == FOLDERS["defaults"]:
        draw(content)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.estimation")
    parser.add_argument("--records", type=int, default=100, help="of each comparison")
    parser.add_argument("--steps", type=int, default=400, help="of each round")
    parser.add_argument("--draw", action="store_true", help="the figure alone")
    run_in_settings(parser, measure)
