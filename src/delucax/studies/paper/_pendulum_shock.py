"""The pendulum figure: planning and online control, without noise and in a shock."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Float

from ... import controllers
from ...controllers import LQR, Zero
from ...costs import Quadratic
from ...dynamics import Discretized, linearize
from ...environments import Environment
from ...planning import ilqr
from ...simulation import rollout
from ...systems import Pendulum
from ._finding import Claim, draw_panels, Finding, mean_and_half_width, paired_ratio


DT, STEPS, BOUND, AHEAD = 0.05, 600, 10.0, 20


def pendulum_shock(small: bool = False) -> Finding:
    """Regulate the inverted pendulum from off upright."""
    seeds, steps = (4, 300) if small else (20, STEPS)
    dynamics = Discretized(Pendulum(), dt=DT, solver=diffrax.Euler())
    cost = Quadratic(jnp.eye(2), jnp.eye(1))
    env = Environment(dynamics, cost, control_bounds=(-BOUND, BOUND))
    model = linearize(dynamics)
    lqr = LQR(model, jnp.eye(2), jnp.eye(1))
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
    # What LQR would cost from there on stands for all that lies beyond the horizon.
    ahead = Quadratic(jnp.eye(2), jnp.eye(1), final=lqr.P)
    mpc = controllers.MPC(dynamics, ahead, AHEAD, bounds=(-BOUND, BOUND))
    contenders: dict[str, Any] = {
        "zero": lambda plan: Zero(1),
        "LQR": lambda plan: lqr,
        "GPC": lambda plan: learner,
        "AdaGPC": lambda plan: controllers.Adaptive(learner),
        "iLQR, open loop": lambda plan: controllers.OpenLoop(plan.controls),
        "iLQR, with gains": lambda plan: plan,
        "MPC": lambda plan: mpc,
        "GPC around the plan": around,
    }
    costs_of = {}
    options: Any = dict(horizon=steps, keep=("costs",), throw=False)
    for name, make in contenders.items():

        @jax.jit
        @jax.vmap
        def costs(plan, x0, w, make=make):
            key = jr.key(0)
            return rollout(env, make(plan), key=key, x0=x0, w=w, **options).costs

        for world, w in worlds.items():
            w = jnp.asarray(w, starts.dtype)
            costs_of[name, world] = np.asarray(costs(plans, starts, w))
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
            "Without noise MPC costs at most 1.01 times what the plan does",
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
            "AdaGPC costs at most 1.02 times what GPC does over the run with the shock",
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
        for name in contenders:
            if name != "zero":
                # Some lie on top of others.
                dashed = "gains" in name or "around" in name or name == "MPC"
                style = "--" if dashed else "-"
                mean_cost = costs_of[name, world].mean(axis=0)
                ax.semilogy(times, mean_cost, style, lw=1.4, label=name)
        ax.set(title=world, xlabel="time, s", ylim=(1e-4, 50))
    axes[1].axvspan(DT * (steps // 3), DT * (2 * steps // 3), color="0.5", alpha=0.15)
    axes[0].set_ylabel("cost of a step")
    labels = axes[0].get_legend_handles_labels()
    axes[0].figure.legend(*labels, loc="outside right", frameon=False)
    notes = (
        "Without feedback rounding alone lets the pendulum fall. "
        f"Upright, g = 10, explicit Euler of {DT} s, torque at most {BOUND:g}, Q = R = "
        f"I, {steps} steps, {seeds} starts off upright; the shock, 0.2 sin(k / 2 pi) "
        "on the velocity with a phase a seed, fills the middle third. MPC looks "
        f"{AHEAD} steps ahead, LQR standing for the rest. Learners have their "
        "defaults. The paper gives no settings. Ratios are of paired means, 95% "
        "intervals."
    )
    title = "Adaptive control for the inverted pendulum"
    tables = {"Average cost": rows}
    return Finding(title, claims, tables, {"pendulum_shock": axes[0].figure}, notes)


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
