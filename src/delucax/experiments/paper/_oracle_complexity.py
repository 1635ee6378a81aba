"""The first figure, left: the calls of the dynamics that iLQR makes."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...costs import Quadratic
from ...environments import planar_quadrotor
from ...planning import count_evaluations, ilqr
from ._finding import Claim, Finding


STEPS, SPACING = 100, 1e-2
SAMPLES = (16, 64, 256)


def oracle_complexity(small: bool = False) -> Finding:
    """Plan a flight of the planar quadrotor with three kinds of derivatives."""
    import matplotlib.pyplot as plt

    dynamics = planar_quadrotor().dynamics
    _, hover = dynamics.equilibrium()
    cost = Quadratic(
        0.1 * jnp.eye(6),
        0.1 * jnp.eye(2),
        final=10 * jnp.eye(6),
        control_target=hover,
    )
    x0 = jnp.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    start = jnp.tile(hover, (STEPS, 1))

    def plan(dynamics, **options):
        return ilqr(dynamics, cost, x0, start, **options)

    rows: list[dict[str, Any]] = []
    traces = {}
    kinds: dict[str, dict[str, Any]] = {
        "automatic": {},
        "central differences": {"finite_difference": SPACING},
    }
    calls, plans = {}, {}
    for name, options in kinds.items():
        found, count = count_evaluations(
            lambda dynamics, options=options: plan(dynamics, **options), dynamics
        )
        calls[name], plans[name] = count, found
        iterations = int(found.iterations)
        traces[name] = np.asarray(found.trace)[: iterations + 1]
        rows.append(
            {
                "derivatives": name,
                "iterations": iterations,
                "cost": float(found.cost),
                "calls": count.primal,
                "Jacobian products": count.tangent + count.cotangent,
            }
        )
    knot = {
        name: _calls_of_a_knot(dynamics, x0, hover, spacing)
        for name, spacing in (("automatic", None), ("central", SPACING))
    }
    sampled = [
        _sampled(dynamics, cost, x0, start, samples, 20 if small else 60)
        for samples in SAMPLES
    ]
    best = float(plans["automatic"].cost)
    gap = abs(float(plans["central differences"].cost) - best) / best
    for samples, trace in zip(SAMPLES, sampled, strict=True):
        rows.append(
            {
                "derivatives": f"{samples} Gaussian samples a knot",
                "iterations": len(trace) - 1,
                "cost": float(trace[-1]),
                "calls": (len(trace) - 1) * STEPS * (2 * samples + 1),
                "Jacobian products": 0,
            }
        )
    claims = [
        Claim(
            "Central differences call the dynamics 2 (6 + 2) = 16 times for each "
            "linearisation, automatic differentiation once",
            f"{knot['central']} against {knot['automatic']}, counted as it happens",
            knot == {"automatic": 1, "central": 16},
        ),
        Claim(
            "The solutions are the same up to the error of the derivatives (1e-3 of "
            "the cost)",
            f"{best:.6f}, the other {gap:.1e} away",
            bool(gap < 1e-3),
        ),
        Claim(
            "With derivatives from samples iLQR does not converge (not within 1e-3 of "
            "the optimum)",
            ", ".join(
                f"{100 * (trace[-1] / best - 1):.2g}% above with {samples}"
                for samples, trace in zip(SAMPLES, sampled, strict=True)
            ),
            bool(all(trace[-1] > best * (1 + 1e-3) for trace in sampled)),
        ),
    ]
    figure, ax = plt.subplots(figsize=(5.5, 3.4), layout="constrained")
    for name, trace in traces.items():
        each = calls[name].primal / max(1, len(trace) - 1)
        ax.loglog(
            each * np.arange(1, len(trace) + 1),
            trace - best + 1e-6,
            "o-",
            ms=3,
            label=name,
        )
    for samples, trace in zip(SAMPLES, sampled, strict=True):
        each = STEPS * (2 * samples + 1)
        x = each * np.arange(1, len(trace) + 1)
        ax.loglog(x, trace - best + 1e-6, lw=1, label=f"{samples} samples")
    ax.set(xlabel="calls of the dynamics", ylabel="cost above the optimum")
    ax.grid(alpha=0.25, lw=0.5)
    ax.legend(frameon=False, fontsize=8)
    notes = (
        f"The planar quadrotor, {STEPS} steps of 0.05 s from (1, 1) at rest to the "
        f"origin, from hovering. Central differences have the spacing {SPACING:g}; the "
        "formula printed in the paper has a plus where the difference needs a minus. "
        "Samples: least squares through antithetic Gaussian perturbations of the same "
        "size, drawn anew at each iteration."
    )
    return Finding(
        "Dynamics calls of model-based planning",
        claims,
        {"One plan": rows},
        {"oracle_complexity": figure},
        notes,
    )


def _calls_of_a_knot(dynamics: Any, x: Any, u: Any, spacing: Any) -> int:
    """Calls of the dynamics for one linearisation."""

    z = jnp.concatenate([x, u])

    def automatic(dynamics):
        return jax.jacfwd(lambda z: dynamics(0.0, z[: len(x)], z[len(x) :]))(z)

    def central(dynamics):
        f = lambda z: dynamics(0.0, z[: len(x)], z[len(x) :])  # noqa: E731
        step = spacing * jnp.eye(len(z))
        ends = [(f(z + e), f(z - e)) for e in step]
        return jnp.stack([(up - down) / (2 * spacing) for up, down in ends])

    _, count = count_evaluations(automatic if spacing is None else central, dynamics)
    return count.primal


def _sampled(dynamics, cost, x0, controls, samples: int, iterations: int) -> np.ndarray:
    """The costs of iLQR with Jacobians that are fitted to random perturbations."""
    n, m, key = len(x0), controls.shape[1], jax.random.key(0)

    def jacobian(key, x, u):
        z = jnp.concatenate([x, u])
        moved = SPACING * jax.random.normal(key, (samples, n + m))
        f = lambda z: dynamics(0.0, z[:n], z[n:])  # noqa: E731
        rise = (jax.vmap(f)(z + moved) - jax.vmap(f)(z - moved)) / 2
        # Evolution strategies: the mean of rise times direction.
        return rise.T @ moved / (samples * SPACING**2)

    def follow(states, controls, feedback, feedforward, rate):
        def step(x, given):
            x_plan, u, K, k = given
            u = u + rate * k - K @ (x - x_plan)
            return dynamics(0.0, x, u), (x, u)

        xs = states[:-1], controls, feedback, feedforward
        last, (x, u) = jax.lax.scan(step, x0, xs)
        states = jnp.concatenate([x, last[None]])
        stage = jax.vmap(lambda x, u: cost(0.0, x, u))(x, u)
        return states, u, jnp.sum(stage) + cost.final(0.0, last)

    @jax.jit
    def iterate(key, states, controls, total):
        keys = jax.random.split(key, STEPS)
        F = jax.vmap(jacobian)(keys, states[:-1], controls)
        gradient = jax.vmap(jax.grad(lambda x, u: cost(0.0, x, u), (0, 1)))
        lx, lu = gradient(states[:-1], controls)
        Q, R = 0.2 * jnp.eye(n), 0.2 * jnp.eye(m)
        end = jax.grad(lambda x: cost.final(0.0, x))(states[-1])

        def back(carry, given):
            V, v = carry
            F, lx, lu = given
            A, B = F[:, :n], F[:, n:]
            H = R + B.T @ V @ B
            K = jnp.linalg.solve(H, B.T @ V @ A)
            k = -jnp.linalg.solve(H, lu + B.T @ v)
            P = Q + A.T @ V @ (A - B @ K)
            return (
                (P + P.T) / 2,
                lx + A.T @ v + (A - B @ K).T @ V @ B @ k * 0 - K.T @ (lu + B.T @ v),
            ), (K, k)

        _, (K, k) = jax.lax.scan(
            back, (20 * jnp.eye(n), end), (F, lx, lu), reverse=True
        )
        rates = 0.5 ** jnp.arange(8)
        tried = jax.vmap(lambda a: follow(states, controls, K, k, a))(rates)
        best = jnp.nanargmin(jnp.where(jnp.isfinite(tried[2]), tried[2], jnp.inf))
        new = jax.tree.map(lambda leaf: leaf[best], tried)
        better = new[2] < total
        keep = lambda a, b: jnp.where(better, a, b)  # noqa: E731
        return keep(new[0], states), keep(new[1], controls), keep(new[2], total)

    zeros = jnp.zeros((STEPS, m, n)), jnp.zeros((STEPS, m))
    states = jnp.tile(x0, (STEPS + 1, 1))
    states, controls, total = follow(states, controls, *zeros, 1.0)
    trace = [float(total)]
    for one in jax.random.split(key, iterations):
        states, controls, total = iterate(one, states, controls, total)
        trace.append(float(total))
    return np.array(trace)
