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

    @jax.jit
    def costs(controller, w):
        options: Any = dict(key=jr.key(0), x0=jnp.zeros(2), horizon=steps)
        options["keep"] = ("costs",)
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
            rows.append({**row, "cost": mean, "+-": half})
    against_lqr = lambda kind: paired_ratio(means["GPC", kind], means["LQR", kind])
    ratio = {kind: against_lqr(kind) for kind in kinds}
    claims = [
        Claim(
            "Under Gaussian noise GPC costs at most 1.05 times what LQR does, which is "
            "optimal there",
            f"{ratio['Gaussian'][0]:.3f} times (to {ratio['Gaussian'][2]:.3f})",
            bool(ratio["Gaussian"][2] <= 1.05),
        )
    ]
    for kind in ("sinusoidal", "constant"):
        other = paired_ratio(means["GPC", kind], means["H-infinity", kind])
        claims.append(
            Claim(
                f"Under a {kind} perturbation GPC costs at most 0.25 times what LQR "
                "does, and less than H-infinity",
                f"{ratio[kind][0]:.3f} times LQR, {other[0]:.3f} times H-infinity",
                bool(ratio[kind][2] <= 0.25 and other[2] < 1),
            )
        )
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
