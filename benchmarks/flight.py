"""`python -m benchmarks.flight`: flying a figure-eight in wind, flying past obstacles.

The planar quadrotor with thrusts between 0 and 1 N, in double precision on one core, 20
draws of a wind that nobody is told of, the same for every method:

- `figure-eight`: two rounds of 8 s in a constant wind of up to a fifth of the weight
  with gusts; how far off the curve, after the first two seconds;
- `obstacles`: three discs that must not be entered, as constraints; what the plans
  violate, and what a flight does that plans again at each step, in calm and in wind.

Prints tables, writes `benchmarks/results/flight.json` and draws
`docs/assets/flight.svg`; `--draw` draws it again from that file. The limits were
written before the first run, and nothing was tuned on these draws.
"""

import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pandas as pd
from jaxtyping import Array

import delucax as dlx
from benchmarks._paired import paired
from benchmarks._results import run_in_parts


RESULTS = Path(__file__).parent / "results" / "flight.json"
FIGURE = Path(__file__).parents[1] / "docs" / "assets" / "flight.svg"
LIMITS = {
    "MPC / LQR": 0.8,
    "MPC / plan, open loop": 0.1,
    "MPC, wind estimated / LQR": 0.5,
    "GPC around the plan / MPC": 1.0,
    "plans that converge, of 20": 20,
    "violation, plans": 1e-6,
    "violation, MPC in calm": 1e-6,
    "arrived in wind, of 20": 20,
}
"""At most these (the end of the interval decides), and at least for counts."""
DRAWS, DT, PERIOD = 20, 0.05, 8.0
STEPS, SETTLED = 320, 40
BOUNDS = (0.0, 1.0)
HOVER = 0.4905
DISCS = np.array([[-1.3, 0.1, 0.3], [-0.7, -0.35, 0.25], [-0.6, 0.5, 0.25]])
"""Centre and radius [m]."""
MARGIN = 0.1
"""By which the discs are enlarged where there is wind [m]."""


def quadrotor(**options: Any) -> dlx.Environment:
    """In the precision of the run."""
    return dlx.make("planar_quadrotor", control_bounds=BOUNDS, **options)


def wind(key: Any, steps: int) -> Array:
    """A force [N] at each step: a constant one, and gusts."""
    size, way, gusts = jr.split(key, 3)
    force = jr.uniform(size, minval=0.05, maxval=0.2)
    angle = jr.uniform(way, maxval=2 * np.pi)
    walk = dlx.disturbances.RandomWalk(0.01, 0.05, size=2)
    steady = force * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    return steady + walk.sequence(gusts, DT * jnp.arange(steps))


class Followed(dlx.AbstractCost):
    """Of the distance to a curve, the lean, the rates and the effort."""

    curve: Any

    def state(self, t, x):
        off = x[:2] - self.curve(t)
        return 10 * off @ off + 0.1 * (x[2] * x[2] + x[5] * x[5])

    def __call__(self, t, x, u):
        return self.state(t, x) + 0.1 * jnp.sum((u - HOVER) ** 2)

    def final(self, t, x):
        return 10 * self.state(t, x)


class Blown(dlx.AbstractDynamics):
    """The quadrotor with the force of a constant wind among its states."""

    calm: dlx.AbstractDynamics

    state_names = ("x", "y", "angle", "vx", "vy", "rate", "force_x", "force_y")
    control_names = ("left", "right")

    @property
    def dt(self):
        return self.calm.dt

    def advance(self, t, x, u, w):
        after, result = self.calm.advance(t, x[:6], u, x[6:])
        return jnp.concatenate([after, x[6:]]), result


class Feeling(dlx.AbstractController):
    """Model predictive control that is told of a wind, which it makes out from how the
    speeds leave the model: a low-pass filter of the forces that are missing.

    Source: Pannocchia and Rawlings, 2003 (offset-free control).
    """

    mpc: dlx.controllers.MPC
    model: Blown
    rate: Array = dlx.parameter(0.3)
    mass: Array = dlx.parameter(0.1)

    def init(self, *, key=None):
        nothing = jnp.zeros(6), jnp.full(2, HOVER)
        return self.mpc.init(key=key), nothing, jnp.zeros(2), jnp.asarray(False)

    def __call__(self, t, y, state):
        inner, (x, u), force, begun = state
        expected = self.model.calm(t - DT, x, u, force)
        missing = (y[3:5] - expected[3:5]) * self.mass / DT
        force = force + jnp.where(begun, self.rate, 0.0) * missing
        u, inner = self.mpc(t, jnp.concatenate([y, force]), inner)
        return u, (inner, (y, u), force, jnp.asarray(True))

    def applied(self, u, cost, state):
        inner, (x, _), force, begun = state
        return inner, (x, u), force, begun


def feeling(env: dlx.Environment, cost: Any, ahead: int, **options: Any) -> Feeling:
    """It, for a task without wind."""
    model = Blown(env.dynamics)
    start = np.tile([HOVER, HOVER], (ahead, 1))
    options = dict(bounds=BOUNDS, start=start, throw=False) | options
    return Feeling(dlx.controllers.MPC(model, cost, ahead, **options), model)


def reference(curve: Any) -> Any:
    """The curve as a state: places and speeds, level."""

    def at(t):
        place, speed = jax.jvp(curve, (t,), (jnp.ones_like(t),))
        zero = jnp.zeros(1, place.dtype)
        return jnp.concatenate([place, zero, speed, zero])

    return at


def figure_eight(quick: bool) -> dict[str, Any]:
    """The error of each method in each wind."""
    steps = 120 if quick else STEPS
    env = quadrotor(horizon=steps)
    curve = dlx.references.FigureEight(PERIOD, 1.0, 0.5)
    cost = Followed(curve)
    x0 = reference(curve)(jnp.zeros(()))
    hover = np.tile([HOVER, HOVER], (steps, 1))
    # No bound is met; without them the gains are those of a whole neighbourhood.
    plan = dlx.planning.ilqr(env.dynamics, cost, x0, hover)
    assert jnp.min(plan.controls) > BOUNDS[0] and jnp.max(plan.controls) < BOUNDS[1]
    model = dlx.linearize(env.dynamics)
    # The weights of the cost; speeds and the lean are what the curve asks for.
    weights = [10.0, 10.0, 0.1, 0.1, 0.1, 0.1], [0.1, 0.1]
    Q, R = (jnp.diag(jnp.array(w)) for w in weights)
    options: Any = dict(reference=reference(curve))
    start = dict(start=np.tile([HOVER, HOVER], (20, 1)))
    learner = dlx.controllers.gpc(env.dynamics, cost, base=plan, horizon=20)
    methods = {
        "LQR": dlx.controllers.LQR(model, Q, R, **options),
        "LQR, preview of 20 steps": dlx.controllers.LQR(
            model, Q, R, preview=20, **options
        ),
        "plan, open loop": dlx.controllers.OpenLoop(plan.controls),
        "plan, with gains": plan,
        "MPC": dlx.controllers.MPC(
            env.dynamics,
            cost,
            20,
            bounds=BOUNDS,
            planner=dlx.planning.ILQR(10),
            throw=False,
            **start,
        ),
        "MPC, wind estimated": feeling(env, cost, 20, planner=dlx.planning.ILQR(10)),
        "GPC around the plan": learner,
    }
    winds = jax.vmap(lambda key: wind(key, steps))(jr.split(jr.key(0), DRAWS))
    target = jax.vmap(curve)(DT * jnp.arange(steps + 1))
    errors, seconds, paths = {}, {}, {}
    for name, controller in methods.items():

        @jax.jit
        def fly(winds, controller=controller):
            def one(w):
                options: Any = dict(key=jr.key(0), x0=x0, w=w, throw=False)
                run = dlx.rollout(env, controller, **options)
                off = run.states[SETTLED:, :2] - target[SETTLED:]
                return jnp.sqrt(jnp.mean(jnp.sum(off**2, axis=1))), run.states[:, :2]

            return jax.lax.map(one, winds)

        jax.block_until_ready(fly(winds))
        began = time.perf_counter()
        found, path = jax.block_until_ready(fly(winds))
        seconds[name] = (time.perf_counter() - began) / DRAWS
        errors[name], paths[name] = np.asarray(found), np.asarray(path[0])
    table = paired(errors, "LQR")
    rows = [
        {
            "method": str(name),
            "error, m, IQM": row["iqm"],
            "low": row["low"],
            "high": row["high"],
            "/ LQR": row["ratio"],
            "/ LQR, low": row["ratio_low"],
            "/ LQR, high": row["ratio_high"],
            "ms a step": 1e3 * seconds[str(name)] / steps,
        }
        for name, row in table.iterrows()
    ]
    checks = []
    for what in list(LIMITS)[:4]:
        method, other = what.split(" / ")
        row = paired({m: errors[m] for m in (method, other)}, other).loc[method]
        found = [float(row[k]) for k in ("ratio", "ratio_low", "ratio_high")]
        checks.append(check(what, found[0], found[2] <= LIMITS[what], found[1:]))
    shown(rows, checks, f"A figure-eight in {DRAWS} winds")
    kept = ("LQR", "MPC", "MPC, wind estimated", "GPC around the plan")
    return {
        "steps": steps,
        "rows": rows,
        "checks": checks,
        "paths": {name: paths[name].round(4).tolist() for name in kept},
    }


def check(what: str, value: float, kept: Any, interval: Any = None) -> dict[str, Any]:
    """A limit, and whether it is kept."""
    row = {"what": what, "measured": value, "limit": LIMITS[what], "kept": bool(kept)}
    return row if interval is None else row | {"interval": interval}


def shown(rows: Any, checks: Any, title: str) -> None:
    """Print both."""
    print(f"\n{title}")
    print(pd.DataFrame(rows).to_string(index=False, float_format="%.4g"))
    print(pd.DataFrame(checks).to_string(index=False, float_format="%.4g"), flush=True)


def inside(x: Any, margin: float = 0.0) -> Any:
    """How far inside each disc, in squares of metres: at most 0 outside."""
    off = x[:2] - DISCS[:, :2]
    return (DISCS[:, 2] + margin) ** 2 - jnp.sum(off**2, axis=1)


class Seen(dlx.AbstractCost):
    """A cost of the quadrotor alone."""

    cost: dlx.AbstractCost

    def __call__(self, t, x, u):
        return self.cost(t, x[:6], u)

    def final(self, t, x):
        return self.cost.final(t, x[:6])


def obstacles(quick: bool) -> dict[str, Any]:
    """Plans past three discs, and flights that plan again at each step."""
    steps, ahead, draws = 80, 30, 3 if quick else DRAWS
    env = quadrotor(horizon=steps)
    cost = dlx.costs.Quadratic(
        np.array([0.2, 0.2, 0.1, 0.1, 0.1, 0.1]),
        np.full(2, 0.1),
        final=np.array([50.0, 50.0, 5.0, 5.0, 5.0, 5.0]),
        control_target=np.full(2, HOVER),
    )
    keys = jr.split(jr.key(1), draws)

    def start_of(key):
        place = jr.uniform(key, (2,), minval=-0.4, maxval=0.4)
        return jnp.concatenate([place + jnp.array([-2.2, 0.0]), jnp.zeros(4)])

    x0 = jax.vmap(start_of)(keys)
    winds = jax.vmap(lambda key: wind(key, steps))(jr.split(jr.key(0), draws))
    avoid = dlx.planning.Constraints(
        lambda t, x, u: inside(x), final_inequality=lambda t, x: inside(x)
    )
    wide = dlx.planning.Constraints(
        lambda t, x, u: inside(x, MARGIN),
        final_inequality=lambda t, x: inside(x, MARGIN),
    )
    hover = np.tile([HOVER, HOVER], (steps, 1))

    @jax.jit
    def plans(x0):
        def one(x0):
            options: Any = dict(bounds=BOUNDS, constraints=avoid, throw=False)
            plan = dlx.planning.ilqr(env.dynamics, cost, x0, hover, **options)
            deepest = jnp.max(jax.vmap(inside)(plan.states))
            good = plan.result == dlx.RESULTS.successful
            return good, deepest, plan.violation, plan.residual, plan.cost, plan.states

        return jax.lax.map(one, x0)

    jax.block_until_ready(plans(x0))
    began = time.perf_counter()
    good, deepest, violation, residual, _, states = jax.block_until_ready(plans(x0))
    each = (time.perf_counter() - began) / draws
    row: dict[str, Any] = {
        "what": "plans",
        "good": int(jnp.sum(good)),
        "deepest, m^2": float(jnp.max(deepest)),
        "violation": float(jnp.max(violation)),
        "residual": float(jnp.max(residual)),
        "ms": 1e3 * each,
    }
    rows, paths = [row], {"plan": np.asarray(states[0, :, :2])}

    planner = dlx.planning.ILQR(100)
    options: Any = dict(bounds=BOUNDS, start=hover[:ahead], planner=planner)
    blind = dlx.controllers.MPC(
        env.dynamics, cost, ahead, constraints=avoid, throw=False, **options
    )
    options = dict(planner=planner, constraints=wide)
    aware = feeling(env, Seen(cost), ahead, **options)

    def flown(controller):
        @jax.jit
        def fly(x0, winds):
            def one(given):
                options: Any = dict(key=jr.key(0), x0=given[0], w=given[1])
                run = dlx.rollout(env, controller, throw=False, **options)
                deepest = jnp.max(jax.vmap(inside)(run.states))
                return deepest, jnp.linalg.norm(run.states[-1, :2]), run.states

            return jax.lax.map(one, (x0, winds))

        return fly

    for name, controller, w in (
        ("MPC in calm", blind, 0 * winds),
        ("MPC in wind", blind, winds),
        (f"MPC in wind, estimated, discs {100 * MARGIN:g} cm wider", aware, winds),
    ):
        fly = flown(controller)
        jax.block_until_ready(fly(x0[:1], w[:1]))
        began = time.perf_counter()
        deep, left, states = jax.block_until_ready(fly(x0, w))
        rows.append(
            {
                "what": name,
                "good": int(jnp.sum(left < 0.3)),
                "deepest, m^2": float(jnp.max(deep)),
                "violation": float(jnp.maximum(jnp.max(deep), 0)),
                "entered a disc": int(jnp.sum(deep > 1e-6)),
                "ms": 1e3 * (time.perf_counter() - began) / draws / steps,
            }
        )
        paths[name] = np.asarray(states[0, :, :2])
    found = {r["what"]: r for r in rows}
    windy = rows[-1]
    most = LIMITS["plans that converge, of 20"]
    worst = max(row["deepest, m^2"], row["violation"])
    calm = found["MPC in calm"]["violation"]
    checks = [
        check("plans that converge, of 20", row["good"], row["good"] >= most),
        check("violation, plans", worst, worst <= LIMITS["violation, plans"]),
        check("violation, MPC in calm", calm, calm <= LIMITS["violation, MPC in calm"]),
        check("arrived in wind, of 20", windy["good"], windy["good"] >= most),
    ]
    shown(rows, checks, f"Past three discs, {draws} starts")
    return {
        "rows": rows,
        "checks": checks,
        "paths": {name: path.round(4).tolist() for name, path in paths.items()},
    }


def draw(content: dict[str, Any]) -> None:
    """The first wind and the first start."""
    import matplotlib.pyplot as plt

    plt.style.use("delucax.plotting.style")
    figure, (eight, past) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    t = np.linspace(0, 2 * np.pi, 200)
    eight.plot(np.sin(t), 0.5 * np.sin(2 * t), "k:", lw=1.2, label="figure-eight")
    for name, path in content["figure-eight"]["paths"].items():
        x, y = np.array(path).T
        eight.plot(x, y, lw=1.2, label=name)
    for x, y, radius in DISCS:
        past.add_patch(plt.Circle((x, y), radius, color="0.85"))
    for name, path in content["obstacles"]["paths"].items():
        x, y = np.array(path).T
        past.plot(x, y, lw=1.2, label=name)
    for ax in (eight, past):
        ax.set(aspect="equal", xlabel="x, m")
        ax.legend(
            fontsize=7,
            loc="upper center",
            ncols=2,
            bbox_to_anchor=(0.5, -0.24),
        )
    eight.set(ylabel="y, m")
    figure.savefig(FIGURE, metadata={"Date": None})


PARTS = {"figure-eight": figure_eight, "obstacles": obstacles}


def main() -> None:
    """Run, print, write and draw."""
    run_in_parts("flight", PARTS, {"limits": LIMITS}, RESULTS, draw)


if __name__ == "__main__":
    main()
