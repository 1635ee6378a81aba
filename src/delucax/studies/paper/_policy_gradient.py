"""The first figure, right: the gradient through the rollout beside evolution
strategies."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from ... import training
from ...controllers import Linear
from ...environments import pendulum
from ._finding import Claim, draw_panels, Finding


HORIZON, RATE, GOAL = 50, 0.01, 2.0
TWICE = 2 * RATE


def policy_gradient(small: bool = False) -> Finding:
    """A linear policy of the pendulum, hanging at first, with torque up to 10."""
    steps, seeds = (400, 3) if small else (1500, 5)
    scales, pairs = ((0.1,), (1, 16)) if small else ((0.05, 0.1, 0.3), (1, 4, 16, 64))

    def train(estimator, seed, rate=RATE):
        options: Any = dict(gradient=estimator, progress=False)
        return np.asarray(train_linear(steps, seed, rate, **options).history.loss)

    exact = train(training.analytic, 0)
    first, faster = _first(exact), _first(train(training.analytic, 0, TWICE))
    rows = [("through the rollout", 1, int(first is not None), first, exact[-1])]
    curves, reached, total, fewest = {}, 0, 0, []
    for scale in scales:
        for count in pairs:
            estimator = training.EvolutionStrategies(scale, 2 * count)
            runs = [train(estimator, seed) for seed in range(seeds)]
            when = [_first(run) for run in runs]
            # The loss itself, which is one more rollout a step, is not charged.
            cost = [2 * count * w for w in when if w is not None]
            reached, total, fewest = reached + len(cost), total + seeds, fewest + cost
            curves[scale, count] = runs
            name = f"evolution strategies, sigma {scale}, {count} pairs"
            median = float(np.median(cost)) if cost else None
            at_end = float(np.median([run[-1] for run in runs]))
            rows.append((name, seeds, len(cost), median, at_end))
    least = min(fewest) if fewest else None
    claims = [
        descent_claim(first, faster),
        Claim(
            "Evolution strategies need more rollouts at every setting and seed",
            f"{reached} of {total} runs get there"
            + ("" if least is None else f", the fastest after {least:,} rollouts"),
            least is None or (first is not None and least > first),
        ),
    ]
    ax = draw_panels(1, (7.5, 3.4))
    ax.plot(np.arange(1, steps + 1), exact, "k", lw=2, label="through the rollout")
    for (scale, count), runs in curves.items():
        x = 2 * count * np.arange(1, steps + 1)
        label = f"ES, sigma {scale}, {count} pairs"
        color, alpha = f"C{scales.index(scale)}", 1 - 0.2 * pairs.index(count)
        median = np.median(runs, axis=0)
        ax.plot(x, median, lw=1, color=color, alpha=alpha, label=label)
    ax.axhline(GOAL, color="0.5", lw=0.8, ls=":")
    ax.set(xscale="log", xlabel="rollouts", ylabel="mean cost of a step")
    ax.figure.legend(frameon=False, fontsize=7, loc="outside right center")
    notes = (
        f"u = -K (angle, velocity), the angle not wrapped; {HORIZON} steps of 0.05 s "
        f"from hanging at rest, torque at most 10; descent with rate {RATE} on the "
        "mean cost of Gym (with the sum it sticks at once). Evolution strategies are "
        f"antithetic, {seeds} seeds a setting, {steps} updates; lines are medians."
    )
    columns = "gradient", "runs", "reach 2.0", "rollouts, median"
    columns += ("cost at the end, median",)
    table = [dict(zip(columns, row, strict=True)) for row in rows]
    tables, figures = {"Rollouts to cost 2.0": table}, {"policy_gradient": ax.figure}
    return Finding("Policy gradient of the pendulum", claims, tables, figures, notes)


@functools.cache
def _mean_cost() -> Callable[..., Any]:
    """Of a step from hanging. One object, so that a second seed does not compile."""
    env = pendulum(max_torque=10.0, initial_state=np.array([np.pi, 0.0]))
    total = training.expected_cost(env, batch=1, horizon=HORIZON)
    return lambda controller, key: total(controller, key) / HORIZON


def train_linear(
    steps: int, seed: int = 0, rate: float = RATE, **options: Any
) -> training.Fitted:
    """Descend with a linear policy from zero; with the options of `fit`."""
    options["key"] = jax.random.key(seed)
    start = Linear(jnp.zeros((1, 2)))
    return training.fit(_mean_cost(), start, optax.sgd(rate), steps, **options)


def descent_claim(first: int | None, faster: int | None) -> Claim:
    """Judged at the paper's rate; what twice the rate brings is said beside it."""
    return Claim(
        "Gradient descent through the rollout reaches cost 2.0 within 120 rollouts",
        f"{first or 'Never, in'} rollouts at the paper's rate {RATE} "
        f"({faster or 'never'} at {TWICE})",
        first is not None and first <= 120,
    )


def _first(losses: np.ndarray) -> int | None:
    """How many rollouts until the cost is at most the goal."""
    below = np.flatnonzero(losses <= GOAL)
    return int(below[0]) + 1 if below.size else None
