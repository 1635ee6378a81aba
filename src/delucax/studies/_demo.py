"""The demo: from the pendulum's ODE to a trained controller, and the paper in small."""

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
from ..controllers import Linear, LQR
from ..dynamics import linearize
from ..environments import Environment, pendulum
from ..simulation import rollout, Trajectory
from ._swing_up import BATCH, holds_upright, HORIZON, STEPS, train_swing_up
from .paper import reproduce, STUDIES
from .paper._finding import mean_and_half_width
from .paper._gradients import train_linear
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
    """Design, train, compare and show controllers for Gym's pendulum; then the studies
    of the Deluca paper, small, and whether its claims hold.

    Takes the pendulum's ODE; designs an LQR about the upright; trains the linear policy
    of the Deluca paper (Section 4) and an MLP by differentiating the rollout; runs them
    and zero control from the same 100 starts, without and with a shock in the middle;
    and writes a table, the controller, a figure and an animation. Then it is
    [`delucax.studies.reproduce`][] with `small`, of all but the ventilator, in the
    folder `paper` beside them.

    **Arguments:**

    - `out`: the folder to write to, `"demo"` by default.
    - `seeds`: how many MLPs to train, 2 by default; the first is the one shown.
    - `steps`: optimiser steps for each, 800 by default.
    - `say`: what to do with a line of text; `print` by default.

    **Returns:** the table of the pendulum, a `pandas.DataFrame`.

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
    gains_of = lambda K: f"  K = {np.array2string(np.asarray(K), precision=3)}"

    say("LQR about the upright, from the linearised ODE")
    weights = np.diag([1.0, 0.1]), np.eye(1) * 0.001
    difference = env.dynamics.difference
    lqr = LQR(linearize(env.dynamics), *weights, difference=difference)
    say(gains_of(lqr.K))

    say("\nLinear policy u = -K x by gradient descent on the rollout (torque +-10)")
    linear = train_linear(1000).model
    say(gains_of(linear.K))
    # Zero control as a linear policy, which shares the program of the other one.
    zero = replace(linear, {"K": 0 * linear.K})
    controllers = {"zero": zero, "LQR": lqr, "linear policy": linear}

    say(f"\nMLP by gradient descent through the ODE, {seeds} seeds")
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
        first = "" if seed else ", compilation included"
        say(
            f"  seed {seed}: {seconds[-1]:.1f} s{first}; swings up and holds from "
            f"{held} of {STARTS} starts"
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
    say(f"\nCost over 20 s from the same {STARTS} starts, torque +-2:\n")
    say(table.to_string(index=False, float_format=lambda x: f"{x:.1f}"))
    say(
        "\nLQR and the linear policy (which was trained with torque +-10) are too weak "
        "at +-2 to\nlift the pendulum from most starts; a shock may by chance bring it "
        "within LQR's reach."
    )

    say(f"\nWriting {out}/")
    table.to_csv(out / "table.csv", index=False)
    save(out / "mlp.dlx", controllers["MLP"])
    # The start that hangs lowest makes the best picture of a swing-up.
    lowest = int(np.argmin(np.cos(starts[:, 0])))
    picture = {name: shown[name, "at 10 s"][lowest] for name in controllers}
    figure: Any = plotting.plot(picture)
    for axes in figure.axes:
        axes.axvspan(10.0, 10.5, color="0.5", alpha=0.25, lw=0)
    low, high = np.array(figure.axes[0].get_ylim()) / (2 * np.pi)
    for upright in 2 * np.pi * np.arange(np.ceil(low), np.floor(high) + 1):
        figure.axes[0].axhline(upright, color="0.5", lw=0.8, ls=":", zorder=0)
    figure.text(0.01, 0.005, "Grey: the shock. Dotted: upright.", fontsize=8)
    figure.savefig(out / "trajectories.png", dpi=120)
    say("  table.csv, mlp.dlx, trajectories.png")
    swing = shown["MLP", "none"][lowest][:160]
    plotting.animate(env, swing, path=out / "swing_up.gif", max_frames=80)
    say("  swing_up.gif")

    trained = BATCH * HORIZON * steps
    usual = float(np.median(seconds[1:] or seconds))
    without = f" ({usual:.1f} s without, the median seed)" if seeds > 1 else ""
    say(
        f"\nTrained on {trained / 1e6:.1f} million steps, gradients included, in "
        f"{seconds[0]:.1f} s with compilation{without}: "
        f"{trained / usual / 1e6:.2f} million steps a second."
    )
    say(_beside_gymnasium(trained / usual))
    say(_derivative())
    say("\nThe Deluca paper, study by study, with few seeds and steps\n")
    names = [name for name in STUDIES if name != "ventilator"]
    claims = reproduce(names, out / "paper", small=True, say=say)
    holds = pd.DataFrame(claims).astype({"holds": int}).groupby("study", sort=False)
    held = holds["holds"].agg(claims="count", hold="sum").reset_index()
    say(f"\n{held.to_string(index=False)}\n")
    for claim in claims:
        if not claim["holds"]:
            say(f"Does not hold: {claim['claim']} ({claim['measured']}).")
    say("\nThe ventilator, in a minute: python -m delucax lung --small")
    say("All of it, with more seeds and steps: python -m delucax reproduce all")
    return table


def _writable(out: Path) -> Path:
    """The folder, made and tried before any work is done."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        message = f"demo: out must be a folder to write to, got {out}: {error}"
        raise OSError(message) from error
    return out


def _evaluate(
    env: Environment, controller: Any, starts: np.ndarray, w: np.ndarray
) -> tuple[Trajectory, np.ndarray]:
    """The runs from all starts, in NumPy, and which of them hold the upright."""
    return jax.device_get(_compiled_runs(env, controller, starts, w))


@eqx.filter_jit
def _compiled_runs(env, controller, starts, w):
    options: Any = dict(key=jax.random.key(0), horizon=EVALUATION_STEPS, throw=False)
    options |= dict(w=w, keep=("states", "controls", "costs"))
    runs = jax.vmap(lambda x0: rollout(env, controller, x0=x0, **options))(starts)
    return runs, holds_upright(runs)


def _beside_gymnasium(steps_per_second: float) -> str:
    """Gymnasium's own speed, measured here and now if it is installed."""
    count = 20_000
    try:
        seconds = take_turns([gymnasium_run(count)], 1)
    except ImportError:
        return "Gymnasium is not installed, so its speed was not measured."
    rate = count / float(seconds[0, 0])
    return (
        f"Gymnasium simulates {rate / 1e6:.3f} million steps a second on this machine: "
        f"training ran {steps_per_second / rate:.0f} times as fast."
    )


def _derivative() -> str:
    """The cost's derivative with respect to the length, beside a central difference."""
    with jax.enable_x64(True):
        env = pendulum(solver=diffrax.Tsit5(), dt=0.02)
        policy, key = Linear(jnp.array([[20.0, 5.0]])), jax.random.key(0)
        options: Any = dict(x0=jnp.array([0.1, 0.0]), horizon=250, throw=False)

        # One program has both.
        @jax.jit
        @jax.value_and_grad
        def both(length):
            longer = replace(env, {"dynamics.system.length": length})
            return rollout(longer, policy, key=key, **options).total_cost

        length, step = jnp.array(1.0), 1e-5
        exact = float(both(length)[1])
        numeric = float((both(length + step)[0] - both(length - step)[0]) / (2 * step))
    return (
        "d(cost)/d(length) through the ODE (Tsit5, float64): "
        f"{exact:.9f}; central difference: {numeric:.9f}."
    )
