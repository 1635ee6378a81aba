"""What policies cost in C: the part `export` of `benchmarks.policies`.

The policy that `training.synthesise` returns for a task within 30 s, and every other
structure that it may return, trained for some steps, are written by `export.c`. The C
takes its place in the closed loop, from the same starts. The costs differ by rounding,
which an unstable or chaotic loop amplifies; so beside the C stands what JAX itself
gives from starts that are moved by one rounding.
"""

import dataclasses
import tempfile
from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pandas as pd

import delucax as dlx
from benchmarks import _cases


STORE = _cases.RESULTS / "exported_policies.jsonl"
LIMIT = 1e-5
"""Of the largest difference of the cost of a start, relative to it."""
BLIND = "pendulum, angle alone"
TASKS = (
    "pendulum",
    BLIND,
    "double_integrator",
    "cartpole_linear",
    "cstr",
    "quadrotor",
    "mountain_car",
    "balloon_lung",
)
FAMILIES = ("pendulum", "cartpole_linear")
"""Tasks of which the structure for a family of plants is exported too."""
PRECISIONS = ("float64", "float32")
WITHOUT_GRADIENT = ("mountain_car",)
"""Tasks whose cost has no gradient to speak of: evolution trains their policies."""
STARTS, STEPS, LONGEST, BUDGET = 16, 200, 100, 30.0


class AngleAlone(dlx.systems.Pendulum):
    """A pendulum whose velocity no sensor shows."""

    def observe(self, t: Any, x: Any) -> Any:
        return x[:1]


def both_parts(y: Any) -> Any:
    """Cosine and sine of the angle."""
    return jnp.stack([jnp.cos(y[0]), jnp.sin(y[0])])


def task_of(name: str) -> dlx.Environment:
    """A task of the scoreboard, or the pendulum that needs a memory."""
    from delucax.studies import _scoreboard

    if name != BLIND:
        return _scoreboard.task_of(name)
    dynamics = dlx.Discretized(AngleAlone(), dt=0.05)
    change: Any = dict(dynamics=dynamics, encode=both_parts, observation_bounds=None)
    return dataclasses.replace(dlx.make("pendulum"), **change)


def policies(env: Any, task: str) -> dict[str, Any]:
    """One of each structure, trained."""
    from delucax.training._synthesis._structures import simplified, structures

    key = jr.key(0)
    found = dlx.training.synthesise(env, key=key, budget=BUDGET, progress=False)
    made = {f"synthesise ({found.structure})": found.policy}
    try:
        if env.dynamics.observes_state:
            law = dlx.controllers.local_lqr(env)
        else:
            law = dlx.controllers.local_lqg(env, key=key)
    except (ValueError, RuntimeError):
        law = None
    # Where the law is what was returned, it counts once.
    if law is not None and type(law).__name__ != found.structure:
        made[type(law).__name__] = law
    horizon = min(env.horizon, LONGEST)
    loss = dlx.training.expected_cost(env, batch=8, horizon=horizon, gradient_decay=0.9)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(5e-3))
    untrained = structures(env, law, False, 32, 1, key)
    if task in FAMILIES:
        untrained |= structures(env, law, True, 32, 1, key)
    for name, policy in untrained.items():
        part = "correction" if isinstance(policy, dlx.controllers.Residual) else None
        how: Any = dict(key=key, trainable=part, progress=False, throw=False)
        if task in WITHOUT_GRADIENT:
            loss = dlx.training.expected_cost(env, batch=2)
            trained = dlx.training.evolve(loss, policy, STEPS, **how)
        else:
            trained = dlx.training.fit(loss, policy, optimiser, STEPS, **how)
        made[name] = simplified(name, trained.model)
    return made


def case(task: str, precision: str) -> dict[str, Any]:
    """The difference of each structure, in this process."""
    jax.config.update("jax_enable_x64", precision == "float64")
    env = task_of(task)
    x0 = jax.vmap(env.reset)(jr.split(jr.key(2**20), STARTS))
    moved = jnp.nextafter(x0, jnp.full_like(x0, jnp.inf))
    made = {}
    for name, policy in policies(env, task).items():
        with tempfile.TemporaryDirectory() as folder:
            size = env.dynamics.observation_size
            dlx.export.c(policy, folder, name="law", example=jnp.zeros(size))
            in_c = dlx.export.load(folder)
        costs = costs_of(env, policy, x0)
        made[name] = {
            "cost": float(np.mean(costs)),
            "difference": off(costs_of(env, in_c, x0), costs),
            "rounding": off(costs_of(env, policy, moved), costs),
        }
    return {"structures": made}


def costs_of(env: Any, policy: Any, starts: Any) -> np.ndarray:
    """The cost from each start."""
    how: Any = dict(key=jr.key(0), keep=(), throw=False)
    runs = [dlx.rollout(env, policy, x0=x0, **how).total_cost for x0 in starts]
    return np.asarray(runs, float)


def off(costs: np.ndarray, expected: np.ndarray) -> float:
    """Their largest difference, relative to the expected one; in a sum over the starts
    differences cancel."""
    differ = costs != expected
    costs, expected = costs[differ], expected[differ]
    return float(np.max(np.abs((costs - expected) / expected), initial=0.0))


def exported(only: list[str], **how: Any) -> dict[str, Any]:
    """Run what is missing, and print what all reach."""
    cases = [
        {"task": task, "precision": precision}
        for task in only or TASKS
        for precision in PRECISIONS
    ]

    def said(row):
        each = row["structures"].items()
        return ", ".join(f"{name} {s['difference']:.1e}" for name, s in each)

    rows = _cases.run("benchmarks._exported_policies", STORE, cases, said, **how)
    table = pd.DataFrame(
        {"task": row["task"], "precision": row["precision"], "structure": name} | of
        for row in rows
        for name, of in row["structures"].items()
    )
    print(table.to_string(index=False, float_format="%.2g"))
    summary = []
    for precision, group in table.groupby("precision"):
        worst = group.loc[group["difference"].idxmax()]
        within = int(np.sum(group["difference"] <= LIMIT))
        print(
            f"{precision}: {within} of {len(group)} within {LIMIT:g}, at most "
            f"{worst['difference']:.1e} ({worst['structure']} of {worst['task']}): "
            f"{'met' if within == len(group) else 'NOT met'}"
        )
        returned = group[group["structure"].str.startswith("synthesise")]
        counts = {"policies": len(group), "within": within, "returned": len(returned)}
        counts["most"] = float(worst["difference"])
        counts["rounding of that"] = float(worst["rounding"])
        counts["most of the returned"] = float(returned["difference"].max())
        summary.append({"precision": precision} | counts)
    return {"rows": table.to_dict("records"), "summary": summary}


if __name__ == "__main__":
    _cases.answer(case)
