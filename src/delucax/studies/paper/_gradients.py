"""Policy gradients: descent through the rollout against evolution strategies (the first
figure, right), and the variance of gradient estimators (Section 2)."""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ... import training
from ..._module import replace
from ...controllers import Gaussian, Linear, MLP, mlp_policy
from ...environments import pendulum
from ...simulation import rollout
from .._swing_up import spread_starts
from ._finding import Claim, draw_panels, Finding, side_by_side


EPISODE, RATE, GOAL = 50, 0.01, 2.0
TWICE = 2 * RATE
BUDGET, HORIZON = 128, 20
"""The number of rollouts in one estimate, and of steps in a rollout."""
ON_WEIGHTS, ON_CONTROLS = 0.01, 0.1
"""The standard deviations of the noise on the weights and on the controls."""
LONGER = (10, 25, 50, 100, 200, 400)
DRAWN = 8
"""The number of rollouts in one estimate with random starts."""


def policy_gradient(small: bool = False) -> Finding:
    """Train a linear policy of a pendulum that hangs at first, with torque up to 10."""
    steps, seeds = (400, 3) if small else (1500, 5)
    scales, pairs = ((0.1,), (1, 16)) if small else ((0.05, 0.1, 0.3), (1, 4, 16, 64))

    def losses(seed, rate=RATE, **options):
        fitted = train_linear(steps, seed, rate, progress=False, **options)
        return np.asarray(fitted.history.loss).T

    exact = losses(0)
    first, faster = _first(exact), _first(losses(0, TWICE))
    rows: Any = [("through the rollout", 1, int(first is not None), first, exact[-1])]
    settings = list(itertools.product(scales, pairs))
    estimators = [training.EvolutionStrategies(s, 2 * count) for s, count in settings]
    evolve = lambda estimator: losses(np.arange(seeds), gradient=estimator)
    curves = dict(zip(settings, side_by_side(evolve, estimators), strict=True))
    fewest = []
    for (scale, count), runs in curves.items():
        when = [_first(run) for run in runs]
        # The loss takes one more rollout per step, which is not counted.
        cost = [2 * count * w for w in when if w is not None]
        fewest += cost
        name = f"evolution strategies, sigma {scale}, {count} pairs"
        median = float(np.median(cost)) if cost else None
        at_end = float(np.median([run[-1] for run in runs]))
        rows.append((name, seeds, len(cost), median, at_end))
    least = min(fewest) if fewest else None
    claims = [
        descent_claim(first, faster),
        Claim(
            "For every setting and seed, evolution strategies need more rollouts than "
            "the gradient",
            f"{len(fewest)} of {seeds * len(curves)} runs get there"
            + ("" if least is None else f", the fastest after {least:,} rollouts"),
            least is None or (first is not None and least > first),
        ),
    ]
    from ..._figures import color_of

    ax = draw_panels(1, (7.5, 3.4))
    ax.plot(np.arange(1, steps + 1), exact, "k", lw=2, label="through the rollout")
    for (scale, count), runs in curves.items():
        x = 2 * count * np.arange(1, steps + 1)
        label = f"ES, sigma {scale}, {count} pairs"
        color, alpha = color_of(scales.index(scale)), 1 - 0.2 * pairs.index(count)
        median = np.median(runs, axis=0)
        ax.plot(x, median, lw=1, color=color, alpha=alpha, label=label)
    ax.axhline(GOAL, color="0.5", lw=0.8, ls=":")
    ax.set(xscale="log", xlabel="rollouts", ylabel="mean cost of a step")
    ax.figure.legend(frameon=False, fontsize=7, loc="outside right center")
    notes = (
        "The policy is u = -K (angle, velocity), with an angle that is not wrapped. An "
        f"episode has {EPISODE} steps of 0.05 s from hanging at rest, with a torque of "
        f"at most 10. Gradient descent has the rate {RATE}, on the mean cost of Gym, "
        "because it gets stuck on the sum. Evolution strategies are antithetic, with "
        f"{seeds} seeds for each setting and {steps} updates. Lines are medians."
    )
    medians = "rollouts, median", "cost at the end, median"
    columns = "gradient", "runs", "reach 2.0", *medians
    table: Any = [dict(zip(columns, row, strict=True)) for row in rows]
    tables, figures = {"Rollouts to cost 2.0": table}, {"policy_gradient": ax.figure}
    return Finding("Policy gradient of the pendulum", claims, tables, figures, notes)


@functools.cache
def _mean_cost() -> Callable[..., Any]:
    """The mean cost per step from hanging. Cached, because a new function would compile
    again."""
    env = pendulum(max_torque=10.0, initial_state=np.array([np.pi, 0.0]))
    total = training.expected_cost(env, batch=1, horizon=EPISODE)
    return lambda controller, key: total(controller, key) / EPISODE


@functools.cache
def _descent(rate: float) -> optax.GradientTransformation:
    """Gradient descent. Cached, because `fit` compiles again for a new one."""
    return optax.sgd(rate)


def train_linear(
    steps: int, seed: Any = 0, rate: float = RATE, **options: Any
) -> training.Fitted:
    """Train a linear policy from zero by gradient descent, or several policies for an
    array of seeds. `options` go to `fit`."""
    start, key_of = Linear(jnp.zeros((1, 2))), jr.key
    if np.ndim(seed):
        start = jax.tree.map(lambda K: jnp.stack([K] * len(seed)), start)
        key_of = jax.vmap(jr.key)
    options["key"] = key_of(seed)
    return training.fit(_mean_cost(), start, _descent(rate), steps, **options)


def descent_claim(first: int | None, faster: int | None) -> Claim:
    """The claim at the paper's rate, with the result at twice the rate beside it."""
    return Claim(
        "Gradient descent through the rollout reaches cost 2.0 within 120 rollouts",
        f"{first or 'Never, in'} rollouts at the paper's rate {RATE} "
        f"({faster or 'never'} at {TWICE})",
        first is not None and first <= 120,
    )


def _first(losses: np.ndarray) -> int | None:
    """The number of rollouts until the cost is at most the goal."""
    below = np.flatnonzero(losses <= GOAL)
    return int(below[0]) + 1 if below.size else None


def estimator_variance(small: bool = False) -> Finding:
    """Compare gradient estimators for networks of growing width."""
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
        each = _estimates([estimators[name] for name in names], draws)
        samples = dict(zip(names, each, strict=True))
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
    over = _over_horizons(LONGER[::4] if small else LONGER, draws)
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
            "The variance of evolution strategies grows in proportion to the number of "
            "parameters (slope 0.8 to 1.2 on log-log axes)",
            f"slope {steep:.2f}",
            0.8 <= steep <= 1.2,
        ),
        Claim(
            "The variance of REINFORCE does not depend on the number of parameters "
            "(slope -0.2 to 0.2), and is not zero",
            f"slope {flat:.2f}, {last:.3g} times the squared gradient",
            abs(flat) <= 0.2 and last > 0,
        ),
        Claim(
            "Over a long horizon with random starts, the variance of the analytic "
            "gradient is larger than that of REINFORCE, for the same number of "
            "rollouts",
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
    # Between the lines, where "best" finds no room.
    free = {"loc": "center", "bbox_to_anchor": (0.5, 0.34)}
    ax.legend(frameon=False, fontsize=8, **free)
    for name in ("analytic", "REINFORCE"):
        each = [row[name] for row in over]
        long.loglog([row["horizon"] for row in over], each, "o-", ms=3, label=name)
    long.set(xlabel="horizon, steps", ylabel="variance")
    long.legend(frameon=False, fontsize=8)
    notes = (
        f"Networks of one hidden layer, {widths[0]} to {widths[-1]} wide, control the "
        f"pendulum for {HORIZON} steps. An estimate takes {BUDGET} rollouts, and there "
        f"are {draws} estimates. The noise is {ON_WEIGHTS} on the weights, or "
        f"{ON_CONTROLS} on the control. The variance is the trace of the covariance. "
        "Against the horizon, the network has width 32, the starts are at any angle "
        f"and speed, and an estimate takes {DRAWN} rollouts. The norms are those of "
        "single rollouts."
    )
    title = "Variance of gradient estimators"
    tables = {"Variance / squared gradient": rows, "Against the horizon": over}
    return Finding(title, claims, tables, {"estimator_variance": ax.figure}, notes)


class _After(eqx.Module):
    """Ends an episode at a time. The time is an array, so all horizons share a
    program."""

    end: Array

    def __call__(self, t, x):
        del x
        return t > self.end


def _over_horizons(horizons: Sequence[int], draws: int) -> list[dict[str, Any]]:
    """The variances for each horizon, with random starts, and the norm of the
    gradient."""
    env = spread_starts(pendulum(terminated=_After(jnp.zeros(()))))
    policy = mlp_policy(env, width=32, depth=1, key=jr.key(0))
    noisy = Gaussian(policy, -1.0, bounds=env.control_bounds)
    drawn, rows = training.LikelihoodRatio(DRAWN), []
    for horizon in horizons:
        # Half a step before the last, because times are rounded.
        until = replace(env, {"terminated.end": (horizon - 0.5) * env.dt})
        one = training.expected_cost(until, batch=1, horizon=max(horizons))
        score = training.scored_cost(until, horizon=max(horizons))
        # The analytic gradients are of single rollouts, for their norms. Their variance
        # is divided by the number of rollouts in an estimate.
        both = [(training.analytic, one, policy), (drawn, score, noisy)]
        each, guesses = _estimates(both, draws)
        norms = np.linalg.norm(each, axis=1)
        row: dict[str, Any] = {"horizon": horizon}
        row["analytic"] = float(np.sum(np.var(each, axis=0))) / DRAWN
        row["REINFORCE"] = float(np.sum(np.var(guesses, axis=0)))
        row["norm, median"] = float(np.median(norms))
        rows.append(row | {"norm, largest": float(np.max(norms))})
    return rows


def _estimates(
    given: list[tuple[Any, Any, Any]], draws: int
) -> list[Float[np.ndarray, "draws weights"]]:
    """Estimates of the gradient by the weights of the policy, one in each row, for each
    given (estimator, loss, model)."""
    return side_by_side(lambda one: np.asarray(_compiled_estimates(one, draws)), given)


@eqx.filter_jit
def _compiled_estimates(given, draws):
    estimator, loss, model = given

    def estimate(key):
        _, gradient = estimator(loss, model, key)
        own = gradient.base if isinstance(gradient, Gaussian) else gradient
        return ravel_pytree(own)[0]

    return jax.lax.map(estimate, jr.split(jr.key(1), draws))
