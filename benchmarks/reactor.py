"""`python -m benchmarks.reactor`: plans of an unstable plant against IPOPT.

In double precision on one core: the stirred-tank reactor of the task `cstr` about its
unstable equilibrium, 30 steps of 0.05 min, the LQR's cost to go at the end. Plans at
their defaults, from open loop, and from states that all rest at the equilibrium; a
limit of the temperature, which the trajectory meets (349.5 K) or not (352 K), in one
plan and in closed loop; model predictive control with an extended Kalman filter that
reads a noisy thermometer. Prints tables, and writes `benchmarks/results/reactor.json`.

The starts are `STARTS` to the digits given, and what IPOPT finds from them is measured
in the same run.

The noise: each step adds 0.003 mol/l and 0.1 K (standard deviations) to the state, the
thermometer is off by 0.2 K, and the filter knows the first state to 0.01 mol/l and
0.5 K.

CasADi is in a virtual environment of its own.
"""

import argparse
import functools
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import delucax as dlx
from benchmarks._machine import describe, keep_programs, limit_cores
from benchmarks._plans import TO_GO
from benchmarks._results import updated
from benchmarks.planning import PEERS, Worker
from delucax.dynamics import AbstractWrapper


RESULTS = Path(__file__).parent / "results" / "reactor.json"
T = 30
STARTS = (0.6495, 346.71), (0.6408, 349.82), (0.6035, 351.85)
BOUNDS = 280.0, 320.0
W, V = jnp.array([0.003, 0.1]), 0.2
SPREAD = jnp.array([0.01, 0.5])
LIMITS = {
    "plan - IPOPT's": 1e-4,
    "with a limit: plan - IPOPT's": 1e-6,
    "with a limit, closed loop: MPC - IPOPT's": 1e-6,
    "MPC - LQR, mean of pairs": 0.0,
    "plan / LQR's rollout - 1, most": 1e-9,
}
"""At most these, absolutely."""


class Thermometer(AbstractWrapper):
    """The reactor, of which the temperature alone is read."""

    dynamics: dlx.AbstractDynamics

    def advance(self, t, x, u, w):
        return self.dynamics.advance(t, x, u, w)

    def observe(self, t, x):
        return x[1:]


@functools.cache
def plant() -> tuple[dlx.Environment, Any, Any]:
    """The task, its LQR, and its cost with the LQR's cost to go at the end."""
    env = dlx.make("cstr")
    x, u = env.dynamics.equilibrium()
    Q, R = jnp.diag(jnp.array([10.0, 0.01])), jnp.array([[0.01]])
    lqr = dlx.controllers.LQR(dlx.linearize(env.dynamics), Q, R)
    known = [[TO_GO[0], TO_GO[1]], [TO_GO[1], TO_GO[2]]]
    np.testing.assert_allclose(lqr.P, known, rtol=1e-11)
    cost = dlx.costs.Quadratic(Q, R, final=lqr.P, state_target=x, control_target=u)
    return env, lqr, cost


def mpc(**options: Any) -> Any:
    """At its defaults."""
    env, _, cost = plant()
    return dlx.controllers.MPC(env.dynamics, cost, T, bounds=BOUNDS, **options)


def below(limit: float) -> Any:
    """A limit of the temperature."""
    return dlx.planning.Constraints(lambda t, x, u: x[1] - limit)


def planned(
    x0: Any, start: Any = T, states: Any = None, constraints: Any = None
) -> Any:
    """A plan of the task."""
    env, _, cost = plant()
    planner = dlx.planning.ILQR(states=states)
    given = env.dynamics, cost, jnp.asarray(x0), start
    return planner(*given, bounds=BOUNDS, constraints=constraints, throw=False)


def first_cost(controller: Any, x0: Any) -> Any:
    """The cost of the first plan of a controller."""
    env, _, cost = plant()
    u, state = controller(jnp.zeros(()), jnp.asarray(x0), controller.init())
    U = jnp.concatenate([u[None], state.controls[:-1]])
    X = dlx.open_loop(env.dynamics, jnp.asarray(x0), U)
    stages = jax.vmap(lambda x, u: cost(0.0, x, u))(X[:-1], U)
    return jnp.sum(stages) + cost.final(0.0, X[-1])


def guess() -> tuple[list, list]:
    """What IPOPT starts from: states and controls that rest at the equilibrium."""
    x, u = plant()[0].dynamics.equilibrium()
    return np.tile(x, (T + 1, 1)).tolist(), np.tile(u, (T, 1)).tolist()


def ipopt(casadi: Worker, name: str) -> Any:
    """A function from a start to cost, success and controls."""
    built = casadi.ask(build=name, solver="ipopt")

    def solve(x0: Any) -> Any:
        start = np.asarray(x0, float).tolist()
        out = casadi.ask(solve=built["id"], starts=[start], guess=guess())
        return out["costs"][0], out["success"][0], np.asarray(out["controls"])

    return solve


def row(what: str, value: Any, limit: str | None = None) -> dict[str, Any]:
    """What was measured, the limit, and whether it was met."""
    found = {"what": what, "measured": float(value)}
    if limit is None:
        return found
    return found | {"limit": LIMITS[limit], "ok": bool(value <= LIMITS[limit])}


def plans(casadi: Worker, quick: bool) -> list[dict[str, Any]]:
    """The three starts; and that no plan costs more than the rollout of the LQR."""
    rows = []
    env, lqr, cost = plant()
    solve = ipopt(casadi, "reactor")
    held = jnp.tile(env.dynamics.equilibrium()[1], (T, 1))
    rest = jnp.tile(env.dynamics.equilibrium()[0], (T + 1, 1))
    for k, x0 in enumerate(STARTS, 1):
        best, fine, _ = solve(x0)
        rows.append(row(f"start {k}: IPOPT", best))
        rows.append(row(f"start {k}: IPOPT, solved", fine))
        ours = planned(x0)
        limit = "plan - IPOPT's"
        rows.append(row(f"start {k}: ilqr", ours.cost))
        rows.append(row(f"start {k}: ilqr - IPOPT's", abs(ours.cost - best), limit))
        rows.append(row(f"start {k}: ilqr, iterations", ours.iterations))
        first = abs(first_cost(mpc(), x0) - best)
        rows.append(row(f"start {k}: first plan of MPC - IPOPT's", first, limit))
        rows.append(row(f"start {k}: rollout of LQR", ours.trace[0]))
        for name, other in (
            ("from controls alone", planned(x0, held)),
            ("from states at rest", planned(x0, held, states=rest)),
        ):
            good = other.result == dlx.RESULTS.successful
            rows.append(row(f"start {k}: ilqr {name}", other.cost))
            rows.append(row(f"start {k}: ilqr {name}, successful", good))
    sides = jnp.linspace(0.3, 0.7, 5 if quick else 17), jnp.linspace(342.0, 352.0, 11)
    grid = jnp.stack(jnp.meshgrid(*sides), axis=-1).reshape(-1, 2)
    short = dlx.Environment(env.dynamics, cost, control_bounds=BOUNDS, horizon=T)
    run = lambda x0: dlx.rollout(short, lqr, key=jr.key(0), x0=x0).total_cost
    costs = jax.jit(jax.vmap(lambda x0: (planned(x0).cost, run(x0))))(grid)
    rows.append(row("states", len(grid)))
    most = jnp.max(costs[0] / costs[1]) - 1
    limit = "plan / LQR's rollout - 1, most"
    rows.append(row(limit, most, limit))
    return rows


def constrained(casadi: Worker, quick: bool) -> list[dict[str, Any]]:
    """A temperature that must not be exceeded: plans, and closed loops without noise,
    each by its own planner."""
    rows, steps = [], 5 if quick else 60
    env, _, cost = plant()
    cases = [(352.0, x0) for x0 in STARTS] + [(349.5, STARTS[0])]
    for limit, x0 in cases:
        name = f"at most {limit:g} K from {x0}"
        solve = ipopt(casadi, f"reactor, at most {limit:g} K")
        best, fine, _ = solve(x0)
        plan = planned(x0, constraints=below(limit))
        rows.append(row(f"{name}: IPOPT", best))
        rows.append(row(f"{name}: IPOPT, solved", fine))
        rows.append(row(f"{name}: ilqr", plan.cost))
        bound = "with a limit: plan - IPOPT's"
        rows.append(row(f"{name}: ilqr - IPOPT's", abs(plan.cost - best), bound))
        rows.append(row(f"{name}: violation", plan.violation))
        controller = mpc(constraints=below(limit))
        task = dlx.Environment(env.dynamics, env.cost, control_bounds=BOUNDS)
        run = dlx.rollout(task, controller, key=jr.key(0), x0=x0, horizon=steps)
        x, total = jnp.asarray(x0), 0.0
        for _ in range(steps):
            u = jnp.asarray(solve(x)[2][0])
            total += float(env.cost(0.0, x, u))
            x = env.dynamics(0.0, x, u)
        total += float(env.cost.final(0.0, x))
        away = abs(float(run.total_cost) - total)
        bound = "with a limit, closed loop: MPC - IPOPT's"
        rows.append(row(f"{name}: closed loop of IPOPT", total))
        rows.append(row(f"{name}: closed loop - IPOPT's", away, bound))
    return rows


def noisy(x0: Any) -> tuple[dlx.Environment, Any]:
    """The task with noise, of which the temperature is read; and the filter."""
    env, _, _ = plant()
    x0 = jnp.asarray(x0)
    measured = Thermometer(env.dynamics)
    task = dlx.Environment(
        measured,
        env.cost,
        initial_state=lambda key: x0 + SPREAD * jr.normal(key, (2,)),
        disturbance=dlx.disturbances.Gaussian(W, size=2),
        sensor_noise=dlx.disturbances.Gaussian(V, size=1),
        control_bounds=BOUNDS,
        horizon=60,
    )
    covariances = jnp.diag(W**2), jnp.array([[V**2]])
    ekf = dlx.estimators.ExtendedKalmanFilter(
        measured, *covariances, mean=x0, covariance=jnp.diag(SPREAD**2)
    )
    return task, ekf


@eqx.filter_jit
def runs(task: dlx.Environment, controller: Any, keys: Any) -> Any:
    """The cost of a run with each key."""
    run = lambda key: dlx.rollout(task, controller, key=key).total_cost
    return jax.lax.map(run, keys)


def noise(casadi: Worker, quick: bool) -> list[dict[str, Any]]:
    """Twenty paired runs of LQR and of MPC, on the estimate of one filter."""
    del casadi
    rows = []
    env, lqr, _ = plant()
    held = dlx.planning.Start(jnp.tile(env.dynamics.equilibrium()[1], (T, 1)))
    contenders = {
        "LQR": lqr,
        "MPC": mpc(),
        "MPC from controls alone": mpc(start=held, throw=False),
    }
    for k, x0 in enumerate(STARTS, 1):
        task, ekf = noisy(x0)
        keys = jr.split(jr.key(0), 4 if quick else 20)
        costs = {}
        for name, controller in contenders.items():
            around = dlx.controllers.OutputFeedback(controller, ekf)
            costs[name] = np.asarray(runs(task, around, keys))
            rows.append(row(f"start {k}: {name}, mean", costs[name].mean()))
        pairs = costs["MPC"] - costs["LQR"]
        error = pairs.std(ddof=1) / np.sqrt(len(pairs))
        limit = "MPC - LQR, mean of pairs"
        rows.append(row(f"start {k}: MPC - LQR, mean of pairs", pairs.mean(), limit))
        rows.append(row(f"start {k}: its standard error", error))
    return rows


PARTS = dict(plans=plans, constrained=constrained, noise=noise)


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reactor")
    parser.add_argument("--quick", action="store_true", help="small sizes, no file")
    parser.add_argument("--part", choices=tuple(PARTS), help="one table alone, again")
    options = parser.parse_args()
    limit_cores(1)
    keep_programs()
    jax.config.update("jax_enable_x64", True)
    casadi = Worker("casadi", *PEERS["casadi"])
    try:
        for name in [options.part] if options.part else PARTS:
            rows = PARTS[name](casadi, options.quick)
            print(f"\n{name}")
            for each in rows:
                print(json.dumps(each), flush=True)
            if not options.quick:
                part = {name: {"machine": describe(), "checks": rows}}
                updated(RESULTS, lambda _, p=part: {"limits": LIMITS} | p)
    finally:
        casadi.close()


if __name__ == "__main__":
    main()
