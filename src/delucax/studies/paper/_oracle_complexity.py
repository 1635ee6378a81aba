"""How often iLQR calls the dynamics (the first figure, left)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from ...costs import Quadratic
from ...dynamics import AbstractDynamics, AbstractWrapper
from ...environments import planar_quadrotor
from ...planning import count_evaluations, ILQR
from ._finding import Claim, draw_panels, Finding


STEPS, SPACING = 100, 1e-2
SAMPLES = (16, 64, 256)


def oracle_complexity(small: bool = False) -> Finding:
    """Plan a flight of the planar quadrotor with three kinds of derivatives."""
    dynamics = planar_quadrotor().dynamics
    _, hover = dynamics.equilibrium()
    weights = 0.1 * np.eye(6), 0.1 * np.eye(2)
    cost = Quadratic(*weights, final=10 * np.eye(6), control_target=hover)
    x0 = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    start = np.tile(hover, (STEPS, 1))
    iterations = 20 if small else 60
    drawn = SAMPLES[1:2] if small else SAMPLES

    def solve(dynamics, **options):
        planner = ILQR(iterations, **options)
        return planner(dynamics, cost, x0, start, throw=False)

    kinds: dict[str, Any] = {
        "automatic": solve,
        "central differences": lambda d: solve(d, finite_difference=SPACING),
    }
    kinds |= {
        f"{samples} samples": lambda d, samples=samples: solve(_Sampled(d, samples))
        for samples in drawn
    }
    solved = {name: count_evaluations(f, dynamics) for name, f in kinds.items()}
    best = float(solved["automatic"][0].cost)
    above = {name: float(plan.cost) / best - 1 for name, (plan, _) in solved.items()}
    rows = [
        {
            "derivatives": name,
            "iterations": int(plan.iterations),
            "cost": float(plan.cost),
        }
        | dict(zip(("calls", "tangents", "cotangents"), count, strict=True))
        for name, (plan, count) in solved.items()
    ]
    z0 = jnp.concatenate([x0, hover])
    step_of = lambda dynamics: lambda z: dynamics(0.0, z[:6], z[6:])

    def differences(dynamics):
        f = step_of(dynamics)
        slope = lambda e: (f(z0 + e) - f(z0 - e)) / (2 * SPACING)
        return jax.lax.map(slope, SPACING * np.eye(len(z0), dtype=z0.dtype))

    counted = lambda f: count_evaluations(eqx.filter_jit(f), dynamics)[1].primal
    automatic = counted(lambda dynamics: jax.jacfwd(step_of(dynamics))(z0))
    central = counted(differences)
    sampled = [name for name in kinds if name.endswith("samples")]
    gap = abs(above["central differences"])
    claims = [
        Claim(
            "Central differences call the dynamics 2 (6 + 2) = 16 times for each "
            "linearisation, automatic differentiation once",
            f"{central} against {automatic}, counted at run time",
            (automatic, central) == (1, 16),
        ),
        Claim(
            "The solutions are the same up to the error of the derivatives (1e-3 of "
            "the cost)",
            f"{best:.6f}; the two costs differ by {gap:.1e}",
            bool(gap < 1e-3),
        ),
        Claim(
            "With derivatives from samples iLQR does not converge (not within 1e-3 of "
            "the optimum)",
            ", ".join(f"{100 * above[n]:.2g}% above with {n}" for n in sampled),
            all(above[name] > 1e-3 for name in sampled),
        ),
    ]
    ax = draw_panels(1, (5.5, 3.4))
    for name, (plan, count) in solved.items():
        trace = np.asarray(plan.trace)[: int(plan.iterations) + 1]
        calls = np.linspace(0, count.primal, len(trace) + 1)[1:]
        style: Any = {"lw": 1} if name in sampled else {"marker": "o", "ms": 3}
        ax.loglog(calls, np.maximum(trace - best, 1e-7), label=name, **style)
    ax.set(xlabel="calls of the dynamics", ylabel="cost above the optimum")
    ax.legend(frameon=False, fontsize=8)
    notes = (
        f"The planar quadrotor flies {STEPS} steps of 0.05 s, from rest at (1, 1) to "
        "the origin. The first guess is to hover. Central differences have the spacing "
        f"{SPACING:g}. The formula in the paper has a plus where it needs a minus. "
        "With samples, the Jacobian is estimated by evolution strategies, from "
        "antithetic Gaussian perturbations of the same size, which are new at each "
        f"point. There are at most {iterations} iterations. The calls are those of the "
        "whole solve, with the line search."
    )
    title = "Dynamics calls of model-based planning"
    tables = {"One plan": rows}
    return Finding(title, claims, tables, {"oracle_complexity": ax.figure}, notes)


class _Sampled(AbstractWrapper):
    """Dynamics whose derivative is estimated from random perturbations."""

    dynamics: AbstractDynamics
    samples: int = eqx.field(static=True)

    def advance(self, t, x, u, w):
        z, result = jnp.concatenate([x, u]), self.dynamics.advance(t, x, u, w)[1]
        return _step((self.dynamics, t, w), z, len(x), self.samples), result


@eqx.filter_custom_jvp
def _step(given, z, n, samples):
    dynamics, t, w = given
    return dynamics.advance(t, z[:n], z[n:], w)[0]


@_step.def_jvp
def _(primals, tangents):
    given, z, n, samples = primals
    # The perturbations are new at each point, and the same for each direction there.
    fold = lambda key, bits: (jr.fold_in(key, bits), None)
    bits = jax.lax.bitcast_convert_type(z.astype(jnp.float32), jnp.uint32)
    key, _ = jax.lax.scan(fold, jr.key(0), bits)
    moved = SPACING * jr.normal(key, (samples, len(z)), z.dtype)
    f = jax.vmap(lambda z: _step(given, z, n, samples))
    up, down = jnp.split(f(jnp.concatenate([z + moved, z - moved])), 2)
    rise = (up - down) / 2
    # E[d (d . v)] = SPACING^2 v for the directions d: the mean of rises times (d . v)
    # is the Jacobian times v.
    tangent = rise.T @ (moved @ tangents[1]) / (samples * SPACING**2)
    return _step(given, z, n, samples), tangent
