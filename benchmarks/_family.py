"""A family of cart-poles: the part `family` of `benchmarks.policies`.

The masses and the length of each plant are within 50% of the nominal ones, and the
pole starts up to 0.8 rad from upright. The cost weighs the force little, so that the
nominal LQR is fast, and saturates at 20 N; on heavy or long plants it then fails about
a quarter of the starts, most of which a law that knows the plant holds. A step of
0.05 s lets a training see all of the 10 s.

A run fails if the pole is ever beyond horizontal, or is not within 0.1 rad of upright
after 10 s. All policies meet the same 500 plants and starts, which none was trained on.

MPC sees 30 steps ahead, and 80 steps in a row of its own: it then holds fewer plants,
because to let the pole fall and swing it up is a plan too. A plan of the whole episode
shows what can be held. It starts from LQR, and from an LQR that lets the cart run,
which has a row too: it holds more plants, at a higher cost.

`network` and `memory` are an ablation: an MLP and a GRU that correct the LQR, trained
by one recipe. It shows whether to remember helps where the plant is not known.
"""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pandas as pd

import delucax as dlx
from benchmarks import _cases


STORE = _cases.RESULTS / "family.jsonl"
SEEDS, PAIRS = 5, 500
NOMINAL = {"cart_mass": 1.0, "pole_mass": 0.1, "half_length": 0.5}
RANGES = {f"dynamics.system.{k}": (0.5 * v, 1.5 * v) for k, v in NOMINAL.items()}
LIMITS = {"of the nominal LQR's failures": 0.5, "above MPC, points": 2.0}
"""At most these, for the median seed."""
QUARTER = 0.2, 0.3
"""The failures of the nominal LQR, for the family to be a test."""
MPC, PLAN = "MPC of each plant", "plan of each plant"
LONG_MPC = "MPC of each plant, 80 steps"
OWN_LQR, RUNNING_LQR = "LQR of each plant", "LQR of each plant, cart let run"
LAWS = ("zero", "LQR", OWN_LQR, RUNNING_LQR, MPC, LONG_MPC, PLAN)
TRAINED = ("synthesise", "network", "memory")
SETTINGS = {
    MPC: {"lookahead": 30, "iterations": 50},
    LONG_MPC: {"lookahead": 80, "iterations": 50},
    PLAN: {"iterations": 200},
}
"""Steps that MPC sees ahead, and the most iterations of a plan."""
RUNNING = 0.01
"""The scale of the weights of the cart, for an LQR that lets it run: that holds every
pole, and a plan from its controls does so too, at less cost."""
TOGETHER = 50
"""Pairs that run together: those that have converged wait for the others."""
STEPS, BATCH, FORGOTTEN = 1500, 32, 0.5
"""Of the ablation: steps of Adam, plants a step, and the seconds over which the
gradient is damped."""


def cartpole() -> dlx.Environment:
    """The nominal plant."""
    spread = [0.05, 0.05, 0.8, 0.05]
    return dlx.make(
        "cartpole",
        **NOMINAL,
        solver=dlx.dynamics.RK4(),
        dt=0.05,
        horizon=200,
        max_force=20.0,
        cost=dlx.costs.Quadratic([1.0, 0.1, 1.0, 0.1], [0.001]),
        initial_state=dlx.environments.UniformState([-s for s in spread], spread),
        terminated=None,
    )


@eqx.filter_jit
def tested(env: Any, law: Any) -> tuple[Any, Any]:
    """Whether each pair fails, and its cost; `law` makes the controller of a plant and
    an initial state."""

    def one(key):
        plant_key, start_key = jr.split(key)
        plant = dlx.randomise(env, plant_key, RANGES)
        how: Any = dict(key=start_key, keep=("states",), throw=False)
        x0 = plant.reset(plant.split_key(start_key)[0])
        run: Any = dlx.rollout(plant, law(plant, x0), x0=x0, **how)
        angle = jnp.abs(run.states[:, 2])
        # A NaN is no success.
        return ~((jnp.max(angle) < jnp.pi / 2) & (angle[-1] < 0.1)), run.total_cost

    keys = jr.split(jr.key(2**20), PAIRS)
    return jax.lax.map(one, keys, batch_size=TOGETHER)


def own_lqr(plant: Any, of_cart: float = 1.0) -> Any:
    """The LQR of a plant with the weights of its cost, those of the cart scaled."""
    scales = jnp.array([of_cart, of_cart, 1.0, 1.0])
    weights = scales * jnp.diag(plant.cost.Q), jnp.diag(plant.cost.R)
    return dlx.controllers.LQR(dlx.linearize(plant.dynamics), *weights)


def own_mpc(plant: Any, lookahead: int, iterations: int) -> Any:
    """MPC with the plant as its model, and its LQR's cost to go at the end."""
    P = own_lqr(plant).P
    cost = dlx.costs.Function(plant.cost, lambda t, x: x @ P @ x)
    planner = dlx.planning.ILQR(max_iterations=iterations)
    how: Any = dict(planner=planner, bounds=plant.control_bounds, throw=False)
    return dlx.controllers.MPC(plant.dynamics, cost, lookahead, **how)


def own_plan(plant: Any, x0: Any, iterations: int) -> Any:
    """A plan of the whole episode, from the cheaper of two LQRs."""
    laws, steps = [own_lqr(plant), own_lqr(plant, RUNNING)], plant.horizon
    x, u, K = (
        jnp.stack([getattr(law, name) for law in laws])[:, None]
        for name in ("x_ref", "u_ref", "K")
    )
    # With their feedback, as the plant is unstable: controls alone would let it fall.
    start = dlx.planning.Start(
        jnp.repeat(u, steps, 1), jnp.repeat(x, steps + 1, 1), jnp.repeat(K, steps, 1)
    )
    how: Any = dict(bounds=plant.control_bounds, throw=False)
    planner = dlx.planning.ILQR(max_iterations=iterations)
    return planner(plant.dynamics, plant.cost, x0, start, **how)


def corrected(env: Any, with_memory: bool, key: Any) -> Any:
    """The LQR with a correction that is trained by the recipe of the ablation."""
    lqr, bounds = dlx.controllers.local_lqr(env), env.control_bounds
    sizes = env.feature_size, env.control_size, 32
    given: Any = dict(features=env.encode, bounds=bounds, key=key)
    network: Any = (
        dlx.controllers.GRU(*sizes, **given)
        if with_memory
        else dlx.controllers.MLP(*sizes, depth=1, **given)
    )
    # The correction is zero at first.
    last = lambda n: n.readout if with_memory else n.network.layers[-1]
    zero = jax.tree.map(jnp.zeros_like, last(network))
    network = eqx.tree_at(last, network, zero)
    policy = dlx.controllers.Residual(lqr, network, bounds)
    decay = float(np.exp(-env.dt / FORGOTTEN))
    loss: Any = dict(batch=1, gradient_decay=decay, ranges=RANGES)
    adam = optax.adam(optax.cosine_decay_schedule(5e-3, STEPS))
    return dlx.training.fit(
        dlx.training.expected_cost(env, **loss),
        policy,
        optax.chain(optax.clip_by_global_norm(1.0), adam),
        STEPS,
        key=jr.fold_in(key, 1),
        trainable="correction",
        gradient=dlx.training.ClippedSamples(BATCH),
        progress=False,
        throw=False,
    ).model


def case(law: str, seed: int, **setting: int) -> dict[str, Any]:
    """What one law does on all pairs, in this process."""
    began, env, key = time.perf_counter(), cartpole(), jr.key(seed)
    about: dict[str, Any] = {}
    if law == "synthesise":
        made = dlx.training.synthesise(env, key=key, ranges=RANGES, progress=False)
        policy, table = made.policy, made.to_pandas()
        about["structure"] = made.structure
        about["report"] = table.to_dict("index")
        about["tried"] = [attempt._asdict() for attempt in made.tried]
    elif law in TRAINED:
        policy = corrected(env, law == "memory", key)
    elif law == "LQR":
        policy = dlx.controllers.local_lqr(env)
    else:
        policy = dlx.controllers.Zero(1)
    seconds = time.perf_counter() - began
    of_each = {
        OWN_LQR: lambda plant, _: own_lqr(plant),
        RUNNING_LQR: lambda plant, _: own_lqr(plant, RUNNING),
        MPC: lambda plant, _: own_mpc(plant, **setting),
        LONG_MPC: lambda plant, _: own_mpc(plant, **setting),
        PLAN: lambda plant, x0: own_plan(plant, x0, **setting),
    }
    failed, costs = tested(env, of_each.get(law, lambda *_: policy))
    failed = "".join(str(int(one)) for one in np.asarray(failed))
    middle = float(np.median(np.asarray(costs)))
    return about | {"seconds": seconds, "failed": failed, "median cost": middle}


def failures(row: dict[str, Any]) -> np.ndarray:
    """Whether each pair fails."""
    return np.array([int(one) for one in row["failed"]])


def family(seeds: int = SEEDS, **how: Any) -> dict[str, Any]:
    """Run what is missing, and print what all reach."""
    # Other settings are other cases.
    cases: list[_cases.Row] = [
        {"law": law, "seed": 0, **SETTINGS.get(law, {})} for law in LAWS
    ]
    cases += [{"law": law, "seed": s} for s in range(seeds) for law in TRAINED]

    def said(row):
        return f"{np.mean(failures(row)):.1%} fail, in {row['seconds']:.0f} s"

    rows = _cases.run("benchmarks._family", STORE, cases, said, **how)
    by_law = {law: [row for row in rows if row["law"] == law] for law in LAWS + TRAINED}
    mpc = failures(by_law[MPC][0])
    made = []
    for law, group in by_law.items():
        if not group:
            continue
        rates = [np.mean(failures(row)) for row in group]
        middle = group[int(np.argsort(rates)[len(rates) // 2])]
        more = failures(middle) - mpc
        made.append(
            {
                "law": law,
                "seeds": len(group),
                "fails, %": 100 * np.median(rates),
                "worst seed": 100 * max(rates),
                "above MPC": 100 * np.mean(more),
                "+-": 196 * np.std(more) / np.sqrt(PAIRS),
                "median cost": np.median([row["median cost"] for row in group]),
                "seconds": max(row["seconds"] for row in group),
            }
        )
    table = pd.DataFrame(made)
    print(table.to_string(index=False, float_format="%.3g"))
    judge(table.set_index("law")["fails, %"])
    return {"plants": PAIRS, "rows": table.to_dict("records")}


def judge(fails: Any) -> None:
    """Print each limit, and whether it is met."""
    if "synthesise" not in fails:
        return
    low, high = (100 * end for end in QUARTER)
    nominal, mpc, own = (fails[k] for k in ("LQR", MPC, "synthesise"))
    said = lambda met: "met" if met else "NOT met"
    print(
        f"the nominal LQR fails {nominal:.1f}%, between {low:g} and {high:g}: "
        f"{said(low <= nominal <= high)}"
    )
    for (what, limit), value in zip(
        LIMITS.items(), (own / nominal, own - mpc), strict=True
    ):
        print(f"{what}: {value:.2f}, at most {limit:g}: {said(value <= limit)}")


if __name__ == "__main__":
    _cases.answer(case)
