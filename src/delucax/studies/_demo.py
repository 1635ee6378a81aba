"""The demo: from the ODE of a pendulum to a controller, then the paper in short."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import plotting
from .._check import check_count
from .._extras import extra
from .._module import replace, save
from ..controllers import Linear, LQR, Zero
from ..dynamics import linearize
from ..environments import Environment, pendulum
from ..simulation import rollout, Trajectory
from ._swing_up import BATCH, holds_upright, HORIZON, STEPS, train_swing_up
from .paper import reproduce, STUDIES
from .paper._finding import mean_and_half_width
from .paper._wall_clock import gymnasium_run, take_turns


EVALUATION_STEPS = 400
STARTS = 100


def demo(
    out: str | Path = "demo",
    *,
    seeds: int = 2,
    steps: int = STEPS,
    say: Callable[[str], Any] = print,
) -> Any:
    """Design, train and compare controllers for Gym's pendulum, then reproduce the
    Deluca paper with fewer seeds and steps.

    The first part designs an LQR about the upright position, and trains MLPs by
    differentiating the rollout. Then it simulates zero control, the LQR and the first
    MLP from the same 100 initial states. Each controller runs without a shock, and with
    a shock in the middle of the run. The first part writes a table, the MLP, a figure
    and an animation. The second part calls [`delucax.studies.reproduce`][] with
    `small=True` for all studies except the ventilator, and writes to the folder `paper`
    inside `out`.

    **Arguments:**

    - `out`: the folder to write to, `"demo"` by default.
    - `seeds`: the number of MLPs to train, 2 by default. The first one is compared.
    - `steps`: the number of optimiser steps for each MLP, 800 by default.
    - `say`: a function that is called with each line of the output; `print` by default.

    **Returns:** a `pandas.DataFrame` with the results for the pendulum.

    **Raises:** `OSError` if the folder cannot be written; `ValueError` if `seeds` is
    below 1.

    !!! example

        ```python
        import tempfile
        from delucax import studies

        with tempfile.TemporaryDirectory() as folder:
            table = studies.demo(folder, seeds=1, steps=20)
        ```
    """
    pd = extra("pandas", "demo")

    check_count(seeds, "seeds", "demo")
    out = _writable(Path(out))
    env = pendulum()

    say("LQR, designed from the ODE linearised about the upright position:")
    weights = np.diag([1.0, 0.1]), np.eye(1) * 0.001
    difference = env.dynamics.difference
    lqr = LQR(linearize(env.dynamics), *weights, difference=difference)
    say(f"  u = -K x with K = {np.array2string(np.asarray(lqr.K[0]), precision=3)}")
    controllers: dict[str, Any] = {"zero": Zero(1), "LQR": lqr}

    say(f"\nMLP, trained by gradient descent through the ODE (seeds: {seeds}):")
    keys = jax.random.split(jax.random.key(2**20), STARTS)
    starts = np.asarray(jax.jit(jax.vmap(env.reset))(keys))
    shock = np.zeros((EVALUATION_STEPS, env.disturbance_size))
    shock[200:210, 1] = 0.3
    worlds = {"none": 0 * shock, "at 10 s": shock}
    seconds = []
    for seed in range(seeds):
        begin = time.perf_counter()
        fitted = train_swing_up(env, key=jax.random.key(seed), steps=steps)
        seconds.append(time.perf_counter() - begin)
        held = np.sum(_evaluate(env, fitted.model, starts, worlds["none"])[1])
        first = "" if seed else " with compilation"
        say(
            f"  seed {seed}: trained in {seconds[-1]:.1f} s{first}. It swings up and "
            f"stays upright from {held} of {STARTS} starts."
        )
        controllers.setdefault("MLP", fitted.model)

    rows, shown = [], {}
    for when, w in worlds.items():
        for name, controller in controllers.items():
            shown[name, when], held = _evaluate(env, controller, starts, w)
            cost = shown[name, when].total_cost
            row: dict[str, Any] = {"controller": name, "shock": when}
            row["mean cost"], row["+- 95%"] = mean_and_half_width(cost)
            row |= {"median": np.median(cost), "worst": cost.max()}
            rows.append(row | {"upright at the end": np.sum(held)})
    table = pd.DataFrame(rows)
    say(
        f"\nCost of 20 s from the same {STARTS} starts (lower is better), with a "
        "torque of at most 2 N m.\nThe last column counts the starts from which the "
        "pendulum is upright for the last 5 s.\n"
    )
    say(table.to_string(index=False, float_format=lambda x: f"{x:.1f}"))
    say(
        "\nThe motor is too weak to lift the pendulum directly. LQR does not swing it "
        "back and forth,\nso it fails from most starts. The shock adds 3 rad/s within "
        "half a second, which happens\nto throw the pendulum upright for LQR from some "
        "starts."
    )

    say(f"\nFiles in {out}/:")
    table.to_csv(out / "table.csv", index=False)
    say("  table.csv         the table above")
    save(out / "mlp.dlx", controllers["MLP"])
    say("  mlp.dlx           the first MLP, which delucax.load reads")
    # The start that hangs lowest makes the best picture of a swing-up.
    lowest = int(np.argmin(np.cos(starts[:, 0])))
    picture = {name: shown[name, "at 10 s"][lowest] for name in controllers}
    _draw(picture).savefig(out / "trajectories.png", dpi=120)
    say("  trajectories.png  angle, velocity, torque and cost with a shock at 10 s")
    swing = shown["MLP", "none"][lowest][:160]
    plotting.animate(env, swing, path=out / "swing_up.gif", max_frames=80)
    say("  swing_up.gif      the swing-up by the MLP")

    trained = BATCH * HORIZON * steps
    usual = float(np.median(seconds[1:] or seconds))
    without = f" ({usual:.1f} s without compilation)" if seeds > 1 else ""
    say(
        f"\nThe training simulated {trained / 1e6:.1f} million steps in "
        f"{seconds[0]:.1f} s{without}: {trained / usual / 1e6:.2f} million steps a "
        "second, gradients included."
    )
    say(_beside_gymnasium(trained / usual))
    say(_derivative())
    say("\nNow the Deluca paper, study by study, with fewer seeds and steps:\n")
    names = [name for name in STUDIES if name != "ventilator"]
    claims = reproduce(names, out / "paper", small=True, say=say)
    holds = pd.DataFrame(claims).astype({"holds": int}).groupby("study", sort=False)
    held = holds["holds"].agg(claims="count", hold="sum").reset_index()
    say(f"\n{held.to_string(index=False)}\n")
    for claim in claims:
        if not claim["holds"]:
            say(f"Does not hold: {claim['claim']} ({claim['measured']}).")
    say("\nThe ventilator study, in about a minute: python -m delucax lung --small")
    say("The paper with all seeds and steps: python -m delucax reproduce all")
    return table


def _writable(out: Path) -> Path:
    """Make the folder, and try to write to it before any work is done."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        message = f"demo: out must be a folder to write to, got {out}: {error}"
        raise OSError(message) from error
    return out


def _draw(runs: dict[str, Trajectory]) -> Any:
    """Draw the run of each controller, the shock in grey, and ticks at half turns."""
    figure: Any = plotting.plot(runs)
    for axes in figure.axes:
        axes.axvspan(10.0, 10.5, color="0.5", alpha=0.25, lw=0)
    angle = figure.axes[0]
    low, high = np.array(angle.get_ylim()) / np.pi
    turns = np.arange(np.ceil(low), np.floor(high) + 1).astype(int)
    where = {0: "0 (upright)", 1: "π (down)"}
    name = lambda k: where.get(k, f"{k}π ({'down' if k % 2 else 'upright'})")
    angle.set_yticks(np.pi * turns, [name(int(k)) for k in turns])
    figure.text(0.01, 0.005, "Grey: the shock, which adds 3 rad/s.", fontsize=8)
    return figure


def _evaluate(
    env: Environment, controller: Any, starts: np.ndarray, w: np.ndarray
) -> tuple[Trajectory, np.ndarray]:
    """The runs from all starts, in NumPy, and whether each of them holds upright."""
    return jax.device_get(_compiled_runs(env, controller, starts, w))


@eqx.filter_jit
def _compiled_runs(env, controller, starts, w):
    options: Any = dict(key=jax.random.key(0), horizon=EVALUATION_STEPS, throw=False)
    options |= dict(w=w, keep=("states", "controls", "costs"))
    runs = jax.vmap(lambda x0: rollout(env, controller, x0=x0, **options))(starts)
    return runs, holds_upright(runs)


def _beside_gymnasium(steps_per_second: float) -> str:
    """A sentence about the speed of Gymnasium, which is measured if it is installed."""
    count = 20_000
    try:
        seconds = take_turns([gymnasium_run(count)], 1)
    except ImportError:
        return "Gymnasium is not installed, so its speed was not measured."
    rate = count / float(seconds[0, 0])
    return (
        f"Gymnasium simulates {rate / 1e6:.3f} million steps a second on this machine, "
        f"without gradients. The training ran {steps_per_second / rate:.0f} times as "
        "fast."
    )


def _derivative() -> str:
    """A sentence about the derivative of the cost with respect to the length, and a
    central difference."""
    with jax.enable_x64(True):
        env = pendulum(solver=diffrax.Tsit5(), dt=0.02)
        policy, key = Linear(jnp.array([[20.0, 5.0]])), jax.random.key(0)
        options: Any = dict(x0=jnp.array([0.1, 0.0]), horizon=250, throw=False)

        # One program for the cost and its derivative.
        @jax.jit
        @jax.value_and_grad
        def both(length):
            longer = replace(env, {"dynamics.system.length": length})
            return rollout(longer, policy, key=key, **options).total_cost

        length, step = jnp.array(1.0), 1e-5
        exact = float(both(length)[1])
        numeric = float((both(length + step)[0] - both(length - step)[0]) / (2 * step))
    return (
        "The derivative of the cost with respect to the pendulum's length is "
        f"{exact:.9f} through the ODE;\na central difference gives {numeric:.9f} "
        "(Tsit5, float64)."
    )
