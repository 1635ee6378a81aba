"""Section 2: the variance of gradient estimators against the number of parameters, and
of the analytic one against the horizon."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.flatten_util import ravel_pytree

from ... import training
from ...controllers import Gaussian, MLP, mlp_policy
from ...environments import pendulum
from ...simulation import rollout
from .._swing_up import spread_starts
from ._finding import Claim, draw_panels, Finding


BUDGET, HORIZON = 128, 20
"""Rollouts in one estimate, and steps in a rollout."""
ON_WEIGHTS, ON_CONTROLS = 0.01, 0.1
"""Standard deviations of the noise."""
LONGER = (10, 25, 50, 100, 200, 400)
DRAWN = 8
"""Rollouts in one estimate where the start is drawn."""


def estimator_variance(small: bool = False) -> Finding:
    """Networks of growing width, of one pendulum's control."""
    # Nearly all of the time is compilation, of each estimator at each width.
    widths = (4, 64) if small else (4, 8, 16, 32, 64, 128, 256)
    draws = 64 if small else 256
    env = pendulum(initial_state=np.array([1.0, 0.0]), horizon=HORIZON)
    score = training.scored_cost(env)
    evolution, likelihood = training.EvolutionStrategies, training.LikelihoodRatio

    def loss(controller, key):
        return rollout(env, controller, key=key, keep=(), throw=False).total_cost

    rows: list[dict[str, Any]] = []
    for width in widths:
        policy = MLP(2, 1, width, 1, key=jr.key(0))
        noisy = Gaussian(policy, float(np.log(ON_CONTROLS)))
        estimators: dict[str, Any] = {
            "analytic": (training.analytic, loss, policy),
            "ES, antithetic": (evolution(ON_WEIGHTS, BUDGET), loss, policy),
            "REINFORCE": (likelihood(BUDGET), score, noisy),
            "ES, one-sided": (evolution(ON_WEIGHTS, BUDGET, False), loss, policy),
            "REINFORCE, no baseline": (likelihood(BUDGET, False), score, noisy),
        }
        names = list(estimators)[: 3 if small else 5]
        samples = {name: _estimates(estimators[name], draws) for name in names}
        exact = samples["analytic"][0]
        scale = exact @ exact
        variance = lambda drawn, by: float(jnp.sum(jnp.var(drawn, axis=0)) / by)
        ratios = {name: variance(drawn, scale) for name, drawn in samples.items()}
        rows.append({"parameters": len(exact)} | ratios)
    ratios = {name: [row[name] for row in rows] for name in rows[0]}
    sizes = ratios.pop("parameters")
    steep, flat = (
        float(np.polyfit(np.log(sizes), np.log(ratios[name]), 1)[0])
        for name in ("ES, antithetic", "REINFORCE")
    )
    last = ratios["REINFORCE"][-1]
    over = [_at_horizon(T, draws) for T in (LONGER[::4] if small else LONGER)]
    exploding = over[-1]["analytic"] / over[0]["analytic"]
    lost = [row["horizon"] for row in over if row["analytic"] > row["REINFORCE"]]
    claims = [
        Claim(
            "The analytic gradient has no variance in a deterministic system (below "
            "1e-9 of its squared norm)",
            f"{max(ratios['analytic']):.1e}",
            bool(max(ratios["analytic"]) < 1e-9),
        ),
        Claim(
            "That of evolution strategies grows in proportion to the parameters "
            "(slope 0.8 to 1.2 on log-log axes)",
            f"slope {steep:.2f}",
            0.8 <= steep <= 1.2,
        ),
        Claim(
            "That of REINFORCE does not depend on the number of parameters (slope -0.2 "
            "to 0.2), but adds to the problem's own",
            f"slope {flat:.2f}, {last:.3g} times the squared gradient",
            abs(flat) <= 0.2 and last > 0,
        ),
        Claim(
            "Over a long horizon, with starts at random, the analytic gradient loses: "
            "its variance grows above that of REINFORCE at as many rollouts",
            f"{exploding:.1e} times from {over[0]['horizon']} to {over[-1]['horizon']} "
            f"steps; above from {lost[0]} steps on"
            if lost
            else "below everywhere",
            bool(lost),
        ),
    ]
    ax, long = draw_panels(2, (9, 3.4))
    for name, values in ratios.items():
        if min(values) > 0:
            ax.loglog(sizes, values, "o-", ms=3, label=name)
    ax.set(xlabel="parameters", ylabel="variance / squared gradient")
    ax.xaxis.set_minor_formatter("")
    ax.legend(frameon=False, fontsize=8)
    for name in ("analytic", "REINFORCE"):
        each = [row[name] for row in over]
        long.loglog([row["horizon"] for row in over], each, "o-", ms=3, label=name)
    long.set(xlabel="horizon, steps", ylabel="variance")
    long.legend(frameon=False, fontsize=8)
    notes = (
        f"Networks of one layer, {widths[0]} to {widths[-1]} wide, for the pendulum, "
        f"{HORIZON} steps; {BUDGET} rollouts in an estimate, {draws} estimates; noise "
        f"of {ON_WEIGHTS} on the weights, or {ON_CONTROLS} on the control. The "
        "variance is the trace of the covariance. Against the horizon: a network of "
        f"width 32, starts at any angle and speed, {DRAWN} rollouts an estimate; the "
        "norms are those of single rollouts."
    )
    title = "Variance of gradient estimators"
    tables = {"Variance / squared gradient": rows, "Against the horizon": over}
    return Finding(title, claims, tables, {"estimator_variance": ax.figure}, notes)


def _at_horizon(horizon: int, draws: int) -> dict[str, Any]:
    """Variances over a horizon, the start drawn, and how large the gradient is."""
    env = spread_starts(pendulum())
    policy = mlp_policy(env, width=32, depth=1, key=jr.key(0))
    noisy = Gaussian(policy, -1.0, bounds=env.control_bounds)
    one = training.expected_cost(env, batch=1, horizon=horizon)
    score = training.scored_cost(env, horizon=horizon)
    # Of single rollouts, so that norms are those of one, and the variance an eighth.
    each = np.asarray(_estimates((training.analytic, one, policy), draws))
    drawn = training.LikelihoodRatio(DRAWN)
    guesses = np.asarray(_estimates((drawn, score, noisy), draws))
    norms = np.linalg.norm(each, axis=1)
    return {
        "horizon": horizon,
        "analytic": float(np.sum(np.var(each, axis=0))) / DRAWN,
        "REINFORCE": float(np.sum(np.var(guesses, axis=0))),
        "norm, median": float(np.median(norms)),
        "norm, largest": float(np.max(norms)),
    }


def _estimates(given: tuple[Any, Any, Any], draws: int) -> jax.Array:
    """Estimates of the gradient by the policy's own weights, a row each; of an
    estimator, a loss and a model."""
    estimator, loss, model = given

    def estimate(key):
        _, gradient = estimator(loss, model, key)
        own = gradient.base if isinstance(gradient, Gaussian) else gradient
        return ravel_pytree(own)[0]

    return jax.lax.map(jax.jit(estimate), jr.split(jr.key(1), draws))
