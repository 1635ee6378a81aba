"""Section 2: the variance of gradient estimators against the number of parameters."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.flatten_util import ravel_pytree

from ...controllers import Gaussian, MLP
from ...environments import pendulum
from ...simulation import rollout
from ...training import analytic, EvolutionStrategies, LikelihoodRatio, scored_cost
from ._finding import Claim, Finding


BUDGET, HORIZON = 128, 20
"""Rollouts in one estimate, and steps in a rollout."""
ON_WEIGHTS, ON_CONTROLS = 0.01, 0.1
"""Standard deviations of the noise."""


def estimator_variance(small: bool = False) -> Finding:
    """Networks of growing width, of one pendulum's control."""
    import matplotlib.pyplot as plt

    widths = (4, 16, 64) if small else (4, 8, 16, 32, 64, 128, 256)
    draws = 64 if small else 256
    env = pendulum(initial_state=np.array([1.0, 0.0]), horizon=HORIZON)
    score = scored_cost(env)

    def loss(controller, key):
        return rollout(env, controller, key=key, keep=(), throw=False).total_cost

    names = ("analytic", "ES, antithetic", "ES, one-sided", "REINFORCE")
    found: dict[str, list[float]] = {name: [] for name in names}
    rows, sizes = [], []
    for width in widths:
        policy = MLP(2, 1, width, 1, key=jr.key(0))
        noisy = Gaussian(policy, float(np.log(ON_CONTROLS)))
        exact = _flat(analytic(loss, policy, jr.key(0))[1])
        size, squared = len(exact), float(exact @ exact)
        sizes.append(size)
        estimators: dict[str, Any] = {
            "analytic": (analytic, loss, policy),
            "ES, antithetic": (EvolutionStrategies(ON_WEIGHTS, BUDGET), loss, policy),
            "ES, one-sided": (
                EvolutionStrategies(ON_WEIGHTS, BUDGET, False),
                loss,
                policy,
            ),
            "REINFORCE": (LikelihoodRatio(BUDGET), score, noisy),
        }
        row: dict[str, Any] = {"parameters": size}
        for name, (estimator, objective, model) in estimators.items():
            estimate = jax.jit(
                lambda key, e=estimator, o=objective, m=model: _flat(e(o, m, key)[1])
            )
            samples = jax.lax.map(estimate, jr.split(jr.key(1), draws))
            row[name] = float(jnp.sum(jnp.var(samples, axis=0))) / squared
            found[name].append(row[name])
        rows.append(row)
    slope = {
        name: float(np.polyfit(np.log(sizes), np.log(values), 1)[0])
        for name, values in found.items()
        if min(values) > 0
    }
    claims = [
        Claim(
            "The analytic gradient has no variance in a deterministic system (below "
            "1e-9 of its squared norm)",
            f"{max(found['analytic']):.1e}",
            bool(max(found["analytic"]) < 1e-9),
        ),
        Claim(
            "That of evolution strategies grows in proportion to the parameters "
            "(slope 0.8 to 1.2 on log-log axes)",
            f"slope {slope['ES, antithetic']:.2f}",
            bool(0.8 <= slope["ES, antithetic"] <= 1.2),
        ),
        Claim(
            "That of REINFORCE does not depend on the number of parameters (slope -0.2 "
            "to 0.2), but adds to the problem's own",
            f"slope {slope['REINFORCE']:.2f}, {found['REINFORCE'][-1]:.3g} times the "
            "squared gradient",
            bool(abs(slope["REINFORCE"]) <= 0.2 and found["REINFORCE"][-1] > 0),
        ),
    ]
    figure, ax = plt.subplots(figsize=(5.5, 3.4), layout="constrained")
    for name, values in found.items():
        if min(values) > 0:
            ax.loglog(sizes, values, "o-", ms=3, label=name)
    ax.set(xlabel="parameters", ylabel="variance / squared gradient")
    ax.grid(alpha=0.25, lw=0.5)
    ax.legend(frameon=False)
    notes = (
        f"Networks of one layer, {widths[0]} to {widths[-1]} wide, for the pendulum, "
        f"{HORIZON} steps; {BUDGET} rollouts in an estimate, {draws} estimates; noise "
        f"of {ON_WEIGHTS} on the weights, or {ON_CONTROLS} on the control. The "
        "variance is the trace of the covariance."
    )
    return Finding(
        "Variance of gradient estimators",
        claims,
        {"Variance / squared gradient": rows},
        {"estimator_variance": figure},
        notes,
    )


def _flat(gradient: Any) -> Any:
    """What is with respect to the policy's own weights."""
    return ravel_pytree(gradient.base if isinstance(gradient, Gaussian) else gradient)[
        0
    ]
