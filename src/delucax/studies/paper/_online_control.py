"""Online control against regulators and plans: the linear-quadratic figure with three
kinds of perturbation, and the pendulum figure without noise and with a shock."""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float

from ... import controllers
from ...controllers import LQR
from ...costs import Quadratic
from ...dynamics import Discretized, LinearDynamics, linearize
from ...environments import Environment
from ...planning import ilqr
from ...simulation import rollout
from ...systems import Pendulum
from ._finding import (
    Claim,
    draw_panels,
    Finding,
    mean_and_half_width,
    paired_ratio,
    side_by_side,
)


DT, STEPS, BOUND, AHEAD = 0.05, 600, 10.0, 20


def pendulum_shock(small: bool = False) -> Finding:
    """Regulate an inverted pendulum that starts off upright."""
    seeds, steps = (4, 300) if small else (20, STEPS)
    dynamics = Discretized(Pendulum(), dt=DT, solver=diffrax.Euler())
    cost = Quadratic(np.eye(2), np.eye(1))
    env = Environment(dynamics, cost, control_bounds=(-BOUND, BOUND))
    model = linearize(dynamics)
    lqr = LQR(model, np.eye(2), np.eye(1))
    rng = np.random.default_rng(0)
    starts = jnp.asarray(rng.uniform(0.3, 0.6, (seeds, 2)) * [1, 0])
    middle = (np.arange(steps) >= steps // 3) & (np.arange(steps) < 2 * steps // 3)
    phases = rng.uniform(0, 2 * np.pi, (seeds, 1))
    wave = 0.2 * np.sin(np.arange(steps) / (2 * np.pi) + phases)
    shock = np.stack([np.zeros_like(wave), np.where(middle, wave, 0)], axis=2)
    worlds = {"no noise": np.zeros_like(shock), "shock": shock}

    def planned(x0):
        guess = rollout(env, lqr, key=jr.key(0), x0=x0, horizon=steps).controls
        return ilqr(dynamics, cost, x0, guess, bounds=(-BOUND, BOUND))

    plans = jax.lax.map(planned, starts)
    learner = controllers.gpc(dynamics, cost, base=lqr)
    horizon = learner.loop.horizon
    around = lambda x: controllers.gpc(dynamics, cost, base=x, horizon=horizon)
    # The cost-to-go of LQR stands for the cost beyond the horizon.
    ahead = Quadratic(np.eye(2), np.eye(1), final=lqr.P)
    mpc = controllers.MPC(dynamics, ahead, AHEAD, bounds=(-BOUND, BOUND))
    contenders: dict[str, Any] = {
        "zero": lambda plan: controllers.Zero(1),
        "LQR": lambda plan: lqr,
        "GPC": lambda plan: learner,
        "AdaGPC": lambda plan: controllers.Adaptive(learner),
        "iLQR, open loop": lambda plan: controllers.OpenLoop(plan.controls),
        "iLQR, with gains": lambda plan: plan,
        "MPC": lambda plan: mpc,
        "GPC around the plan": around,
    }
    costs_of = _costs(env, contenders, worlds, starts, plans)
    during = {key: value[:, middle].mean(axis=1) for key, value in costs_of.items()}
    means = {key: value.mean(axis=1) for key, value in costs_of.items()}
    rows = []
    for name in contenders:
        row: dict[str, Any] = {"controller": name}
        for world in worlds:
            mean, half = mean_and_half_width(means[name, world])
            row |= {f"{world}: cost": mean, f"{world}: +-": half}
        row["during the shock"] = during[name, "shock"].mean()
        rows.append(row)
    quiet = {name: means[name, "no noise"] for name in contenders}
    plan = paired_ratio(quiet["iLQR, with gains"], quiet["GPC"])

    def in_shock(statement: str, one: str, other: str) -> Claim:
        return _at_most(statement, during[one, "shock"], during[other, "shock"])

    claims = [
        Claim(
            "Without noise the plan of iLQR costs no more than online control",
            f"{plan[0]:.3f} times GPC",
            bool(plan[2] <= 1.001),
        ),
        _at_most(
            "Without noise the cost of MPC is at most 1.01 times the cost of the plan",
            *(quiet["MPC"], quiet["iLQR, with gains"], 1.01, 4),
        ),
        in_shock("During the shock GPC costs less than LQR", "GPC", "LQR"),
        in_shock(
            "During the shock GPC costs less than iLQR with its gains",
            *("GPC", "iLQR, with gains"),
        ),
        in_shock(
            "During the shock GPC costs less than MPC, which plans again at each step",
            *("GPC", "MPC"),
        ),
        _at_most(
            "Over the run with the shock the cost of AdaGPC is at most 1.02 times the "
            "cost of GPC",
            *(means["AdaGPC", "shock"], means["GPC", "shock"], 1.02),
        ),
        in_shock(
            "GPC around the plan costs less during the shock than the plan alone",
            *("GPC around the plan", "iLQR, with gains"),
        ),
    ]
    axes = draw_panels(2, (9, 3.2), sharey=True)
    times = DT * np.arange(steps)
    for ax, world in zip(axes, worlds, strict=True):
        names = [name for name in contenders if name != "zero"]
        # Several lines coincide, so the thinner ones are drawn last.
        for name, width in zip(names, range(len(names), 0, -1), strict=True):
            mean_cost = costs_of[name, world].mean(axis=0)
            ax.semilogy(times, mean_cost, lw=width, label=name)
        ax.set(title=world, xlabel="time, s", ylim=(1e-4, 50))
    axes[1].axvspan(DT * (steps // 3), DT * (2 * steps // 3), color="0.5", alpha=0.15)
    axes[0].set_ylabel("cost of a step")
    labels = axes[0].get_legend_handles_labels()
    axes[0].figure.legend(*labels, loc="outside right", frameon=False)
    notes = (
        "Lines that coincide are drawn over each other, the later ones thinner. "
        "Without feedback, rounding alone lets the pendulum fall. The pendulum has "
        f"g = 10, explicit Euler steps of {DT} s, a torque of at most {BOUND:g}, "
        f"Q = R = I, {steps} steps, and {seeds} starts off upright. The shock, "
        "0.2 sin(k / 2 pi) on the velocity with a phase for each seed, fills the "
        f"middle third. MPC looks {AHEAD} steps ahead, and the cost-to-go of LQR "
        "stands for the rest. Learners have their defaults. The paper gives no "
        "settings. Ratios are of paired means, with 95% intervals."
    )
    title = "Adaptive control for the inverted pendulum"
    tables = {"Average cost": rows}
    return Finding(title, claims, tables, {"pendulum_shock": axes[0].figure}, notes)


def _costs(
    env: Environment,
    contenders: dict[str, Callable[[Any], Any]],
    worlds: dict[str, Float[np.ndarray, "seeds steps states"]],
    starts: Float[Array, "seeds states"],
    plans: Any,
) -> dict[tuple[str, str], Float[np.ndarray, "seeds steps"]]:
    """The cost of each step, by controller and world. All controllers meet the same
    disturbances.

    A contender makes a controller from the plan of a seed.
    """
    options: Any = dict(key=jr.key(0), keep=("costs",), throw=False)

    def run_all(name):
        @jax.jit
        @jax.vmap
        def run(plan, x0, w):
            controller = contenders[name](plan)
            return rollout(env, controller, x0=x0, w=w, horizon=len(w), **options).costs

        given = {world: np.asarray(w, starts.dtype) for world, w in worlds.items()}
        by_world = {world: run(plans, starts, w) for world, w in given.items()}
        return {(name, world): np.asarray(costs) for world, costs in by_world.items()}

    costs: dict[tuple[str, str], Any] = {}
    for of_contender in side_by_side(run_all, contenders):
        costs |= of_contender
    return costs


def _at_most(
    statement: str,
    costs: Float[np.ndarray, " n"],
    others: Float[np.ndarray, " n"],
    limit: float | None = None,
    digits: int = 3,
) -> Claim:
    """A claim that the ratio of costs is at most `limit`, or below 1."""
    interval = paired_ratio(costs, others)
    ratio, low, high = (f"{end:.{digits}f}" for end in interval)
    holds = interval[2] < 1 if limit is None else interval[2] <= limit
    return Claim(statement, f"{ratio} times ({low} to {high})", bool(holds))


def lq_perturbations(small: bool = False) -> Finding:
    """Regulate a double integrator, on which zero control diverges."""
    from matplotlib.ticker import LogLocator

    # With fewer steps, the time that GPC takes to learn would count for more.
    seeds, steps = 5 if small else 20, 1000
    A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
    dynamics, cost = LinearDynamics(A, B), Quadratic(np.eye(2), np.eye(1))
    env = Environment(dynamics, cost)
    weights = np.eye(2), np.eye(1)
    contenders = {
        "LQR": LQR(dynamics, *weights),
        "H-infinity": controllers.HInfinity(dynamics, *weights),
        "GPC": controllers.gpc(dynamics, cost),
    }
    t = np.arange(steps)[:, None]
    phases = np.random.default_rng(0).uniform(0, 2 * np.pi, (seeds, 1, 1))
    kinds = {
        "Gaussian": np.random.default_rng(1).normal(size=(seeds, steps, 2)),
        "sinusoidal": np.sin(t / (2 * np.pi) + phases) * np.ones(2),
        "constant": np.ones((seeds, steps, 2)),
    }

    starts = jnp.zeros((seeds, 2))
    made = {name: lambda _, one=one: one for name, one in contenders.items()}
    costs_of = _costs(env, made, kinds, starts, starts)
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
            "Under Gaussian noise, where LQR is optimal, the cost of GPC is at most "
            "1.05 times the cost of LQR",
            f"{ratio:.3f} times (to {high:.3f})",
            bool(high <= 1.05),
        )
    ]
    for kind in ("sinusoidal", "constant"):
        lqr, robust = gpc_over("LQR", kind), gpc_over("H-infinity", kind)
        statement = (
            f"Under a {kind} perturbation the cost of GPC is at most 0.25 times the "
            "cost of LQR, and lower than the cost of H-infinity"
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
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("")
    axes[0].set_ylabel("average cost so far")
    axes[0].legend(frameon=False)
    notes = (
        f"The double integrator starts from rest, with Q = R = I, {steps} steps and "
        f"{seeds} seeds. All controllers have their defaults, and meet the same "
        "perturbations. The paper gives neither matrices nor horizon. Intervals are "
        "95%."
    )
    title = "Linear-quadratic control with adversarial perturbations"
    tables = {"Average cost": rows}
    return Finding(title, claims, tables, {"lq_perturbations": axes[0].figure}, notes)
