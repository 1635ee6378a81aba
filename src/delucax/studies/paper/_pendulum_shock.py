"""The pendulum figure: planning and online control, without noise and in a shock."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

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
    wave = 0.2 * np.sin(
        np.arange(steps) / (2 * np.pi) + rng.uniform(0, 2 * np.pi, (seeds, 1))
    )
    shock = np.stack([np.zeros_like(wave), np.where(middle, wave, 0)], axis=2)
    worlds = {"no noise": np.zeros_like(shock), "shock": shock}

    def planned(x0):
        guess = rollout(env, lqr, key=jr.key(0), x0=x0, horizon=steps).controls
        return ilqr(dynamics, cost, x0, guess, bounds=(-BOUND, BOUND))

    plans = jax.lax.map(planned, starts)
    learner = controllers.GPC(dynamics, cost, base=lqr)
    # What LQR would cost from there on stands for all that lies beyond the horizon.
    ahead = Quadratic(jnp.eye(2), jnp.eye(1), final=lqr.P)
    mpc = controllers.MPC(dynamics, ahead, AHEAD, bounds=(-BOUND, BOUND))
    contenders: dict[str, Any] = {
        "zero": lambda plan: Zero(1),
        "LQR": lambda plan: lqr,
        "GPC": lambda plan: learner,
        "AdaGPC": lambda plan: controllers.Adaptive(learner),
        "iLQR, open loop": lambda plan: controllers.Sequence(plan.controls),
        "iLQR, with gains": lambda plan: plan,
        "MPC": lambda plan: mpc,
        "GPC around the plan": lambda plan: controllers.GPC(
            dynamics, cost, base=plan, horizon=learner.loop.horizon
        ),
    }
    found = {}
    for name, make in contenders.items():

        @jax.jit
        def costs(plans, starts, w, make=make):
            def one(plan, x0, w):
                options: Any = dict(key=jr.key(0), horizon=steps, throw=False)
                run = rollout(env, make(plan), x0=x0, w=w, keep=("costs",), **options)
                return run.costs

            return jax.vmap(one)(plans, starts, w)

        for world, w in worlds.items():
            w = jnp.asarray(w, starts.dtype)
            found[name, world] = np.asarray(costs(plans, starts, w))
    during = {key: value[:, middle].mean(axis=1) for key, value in found.items()}
    means = {key: value.mean(axis=1) for key, value in found.items()}
    rows = []
    for name in contenders:
        row: dict[str, Any] = {"controller": name}
        for world in worlds:
            mean, half = mean_and_half_width(means[name, world])
            row |= {f"{world}: cost": mean, f"{world}: +-": half}
        row["during the shock"] = during[name, "shock"].mean()
        rows.append(row)
    gpc = paired_ratio(during["GPC", "shock"], during["LQR", "shock"])
    ada = paired_ratio(means["AdaGPC", "shock"], means["GPC", "shock"])
    plan = paired_ratio(means["iLQR, with gains", "no noise"], means["GPC", "no noise"])
    late = paired_ratio(during["GPC", "shock"], during["iLQR, with gains", "shock"])
    again = paired_ratio(
        means["MPC", "no noise"], means["iLQR, with gains", "no noise"]
    )
    unaware = paired_ratio(during["GPC", "shock"], during["MPC", "shock"])
    both = paired_ratio(
        during["GPC around the plan", "shock"], during["iLQR, with gains", "shock"]
    )
    claims = [
        Claim(
            "Without noise the plan of iLQR costs no more than online control",
            f"{plan[0]:.3f} times GPC",
            bool(plan[2] <= 1.001),
        ),
        Claim(
            "Without noise MPC costs at most 1.01 times what the plan does",
            f"{again[0]:.4f} times ({again[1]:.4f} to {again[2]:.4f})",
            bool(again[2] <= 1.01),
        ),
        Claim(
            "During the shock GPC costs less than LQR",
            f"{gpc[0]:.3f} times ({gpc[1]:.3f} to {gpc[2]:.3f})",
            bool(gpc[2] < 1),
        ),
        Claim(
            "During the shock GPC costs less than iLQR with its gains",
            f"{late[0]:.3f} times ({late[1]:.3f} to {late[2]:.3f})",
            bool(late[2] < 1),
        ),
        Claim(
            "During the shock GPC costs less than MPC, which plans again at each step",
            f"{unaware[0]:.3f} times ({unaware[1]:.3f} to {unaware[2]:.3f})",
            bool(unaware[2] < 1),
        ),
        Claim(
            "AdaGPC costs at most 1.02 times what GPC does over the run with the shock",
            f"{ada[0]:.3f} times ({ada[1]:.3f} to {ada[2]:.3f})",
            bool(ada[2] <= 1.02),
        ),
        Claim(
            "GPC around the plan costs less during the shock than the plan alone",
            f"{both[0]:.3f} times ({both[1]:.3f} to {both[2]:.3f})",
            bool(both[2] < 1),
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
                mean_cost = found[name, world].mean(axis=0)
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
    return Finding(
        "Adaptive control for the inverted pendulum",
        claims,
        {"Average cost": rows},
        {"pendulum_shock": axes[0].figure},
        notes,
    )
