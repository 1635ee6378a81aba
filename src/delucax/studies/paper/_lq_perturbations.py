"""The linear-quadratic figure: three controllers under three kinds of perturbation."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from ... import controllers
from ...costs import Quadratic
from ...dynamics import LinearDynamics
from ...environments import Environment
from ...simulation import rollout
from ._finding import Claim, draw_panels, Finding, mean_and_half_width, paired_ratio


STEPS = 1000


def lq_perturbations(small: bool = False) -> Finding:
    """Zero control diverges on this plant: LQR is the row to beat."""
    # Over fewer steps the time that GPC takes to learn would count for more.
    seeds, steps = 5 if small else 20, STEPS
    A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
    dynamics, cost = LinearDynamics(A, B), Quadratic(jnp.eye(2), jnp.eye(1))
    env = Environment(dynamics, cost)
    contenders = {
        "LQR": controllers.LQR(dynamics, jnp.eye(2), jnp.eye(1)),
        "H-infinity": controllers.HInfinity(dynamics, jnp.eye(2), jnp.eye(1)),
        "GPC": controllers.gpc(dynamics, cost),
    }
    t = np.arange(steps)[:, None]
    phases = np.random.default_rng(0).uniform(0, 2 * np.pi, (seeds, 1, 1))
    kinds = {
        "Gaussian": np.random.default_rng(1).normal(size=(seeds, steps, 2)),
        "sinusoidal": np.sin(t / (2 * np.pi) + phases) * np.ones(2),
        "constant": np.ones((seeds, steps, 2)),
    }

    options: Any = dict(key=jr.key(0), x0=jnp.zeros(2), horizon=steps, keep=("costs",))

    @jax.jit
    def costs(controller, w):
        return jax.vmap(lambda w: rollout(env, controller, w=w, **options).costs)(w)

    costs_of = {
        (name, kind): np.asarray(costs(controller, jnp.asarray(w, A.dtype)))
        for name, controller in contenders.items()
        for kind, w in kinds.items()
    }
    rows, means = [], {key: value.mean(axis=1) for key, value in costs_of.items()}
    for kind in kinds:
        for name in contenders:
            mean, half = mean_and_half_width(means[name, kind])
            row = {"perturbation": kind, "controller": name}
            rows.append(row | {"cost": mean, "+-": half})
    gpc_over = lambda name, kind: paired_ratio(means["GPC", kind], means[name, kind])
    ratio, _, high = gpc_over("LQR", "Gaussian")
    claims = [
        Claim(
            "Under Gaussian noise GPC costs at most 1.05 times what LQR does, which is "
            "optimal there",
            f"{ratio:.3f} times (to {high:.3f})",
            bool(high <= 1.05),
        )
    ]
    for kind in ("sinusoidal", "constant"):
        lqr, robust = gpc_over("LQR", kind), gpc_over("H-infinity", kind)
        statement = (
            f"Under a {kind} perturbation GPC costs at most 0.25 times what LQR does, "
            "and less than H-infinity"
        )
        measured = f"{lqr[0]:.3f} times LQR, {robust[0]:.3f} times H-infinity"
        holds = bool(lqr[2] <= 0.25 and robust[2] < 1)
        claims.append(Claim(statement, measured, holds))
    axes = draw_panels(3, (10, 3))
    for ax, kind in zip(axes, kinds, strict=True):
        for name in contenders:
            average = np.cumsum(costs_of[name, kind], axis=1) / np.arange(1, steps + 1)
            ax.plot(average.mean(axis=0), label=name, lw=1.5)
        ax.set(title=kind, xlabel="step", yscale="log")
    axes[0].set_ylabel("average cost so far")
    axes[0].legend(frameon=False)
    notes = (
        f"The double integrator, Q = R = I, from rest, {steps} steps, {seeds} seeds "
        "with the same perturbations for all; all at their defaults. The paper gives "
        "neither matrices nor horizon. Intervals are 95%."
    )
    title = "Linear-quadratic control with adversarial perturbations"
    tables = {"Average cost": rows}
    return Finding(title, claims, tables, {"lq_perturbations": axes[0].figure}, notes)
