"""`python -m benchmarks.events`: plants that bounce, switch and wait.

Ten bounces against their closed form, derivatives that other libraries were reported to
miss, periodic gaits against published ones, delays against exact sampled systems; a
throw with one bounce that iLQR plans; a walker that is trained through its impacts; and
what events cost: the gradient, a batch, and the first answer in a fresh process. Double
precision on one core. Prints tables, writes `benchmarks/results/events.json` and the
tables of `docs/events.md`; `--part speed`, or another, runs one again, and `--draw`
writes the tables from the file alone.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array

import delucax as dlx
from benchmarks._event_accuracy import PARTS as ACCURACY, row
from benchmarks._results import run_in_parts
from benchmarks._timing import compiled, in_fresh_process, race
from benchmarks._walking import walker


RESULTS = Path(__file__).parent / "results" / "events.json"
PAGE = Path(__file__).parents[1] / "docs" / "events.md"
WHOLE = "starts", "starts, finer steps", "fewest steps"
TARGET = np.array([3.0, 1.0])


class Throw(dlx.systems.AbstractHybridSystem):
    """A ball in the plane that a hand pushes until it lets go, and that bounces."""

    release: Array = dlx.parameter(0.25)

    state_names = "x", "y", "x rate", "y rate", "mode"
    control_names = "x force", "y force"
    mode_names = "held", "free"
    event_names, event_directions = ("release", "bounce"), (1, -1)

    def vector_field(self, t, x, u, w):
        push = jnp.where(self.mode(x) == 0, u, 0)
        return jnp.stack([x[2], x[3], push[0], push[1] - 9.81, 0 * x[4]])

    def guards(self, t, x, u):
        return t - self.release, x[1]

    def enabled(self, t, x, u):
        return self.mode(x) == 0, self.mode(x) == 1

    def resets(self, t, x, u):
        return x.at[4].set(1), x * jnp.array([1, 1, 0.9, -0.8, 1], x.dtype)


def throw(quick: bool) -> list[dict[str, Any]]:
    """A plan to a target behind a bounce, followed in a rollout; and a plan at a kink,
    where a bounce moves to another interval."""
    del quick
    dynamics, steps = dlx.Discretized(Throw(), dt=0.1), 12
    final = 1e3 * jnp.diag(jnp.array([1.0, 1.0, 0.0, 0.0, 0.0]))
    target = np.concatenate([TARGET, np.zeros(3)])
    zero = jnp.zeros((5, 5))
    cost = dlx.costs.Quadratic(zero, 1e-3 * jnp.eye(2), final, target)
    x0 = np.array([0.0, 1.5, 0.0, 0.0, 0.0])
    plan = dlx.planning.ilqr(dynamics, cost, x0, jnp.zeros((steps, 2)))
    env = dlx.Environment(dynamics, cost, horizon=steps)
    options: Any = dict(key=jax.random.key(0), x0=x0, keep=("states", "events"))
    run = dlx.rollout(env, plan, **options)
    missed = np.linalg.norm(run.states[-1][:2] - TARGET)
    bounces = sum(name == "bounce" for _, name in run.event_list())

    ball = dlx.Discretized(dlx.systems.BouncingBall(), dt=0.05)
    reach = jnp.diag(jnp.array([1e3, 0.0]))
    high = dlx.costs.Quadratic(zero[:2, :2], 0.1 * jnp.eye(1), reach, [0.6, 0.0])
    kink = dlx.planning.ilqr(ball, high, [1.0, 0.0], jnp.zeros((20, 1)), throw=False)
    changed = kink.result == dlx.RESULTS.events_changed
    return [
        row("throw: distance from the target [m]", missed, 0.01),
        row("throw: bounces", bounces),
        row("throw: iterations", plan.iterations),
        row("at a kink: ends with events_changed", bool(changed)),
        row("at a kink: distance from the height [m]", abs(kink.states[-1, 0] - 0.6)),
    ]


class Fall(dlx.AbstractSystem):
    """The ball without a floor."""

    state_names, control_names = ("height", "velocity"), ("force",)

    def vector_field(self, t, x, u, w):
        return jnp.stack([x[1], u[0] - 0.0 * x[1] * jnp.abs(x[1]) - 9.81])


def speed(quick: bool) -> list[dict[str, Any]]:
    """The same fall with and without a floor: 2 s by RK4 at 0.05 s, by turns."""
    steps, rounds = 40, 21 if quick else 201
    lanes = 1024
    controls = jnp.zeros((steps, 1))
    x0 = jnp.array([1.0, 0.0])
    starts = jnp.stack([jnp.linspace(0.5, 2.0, lanes), jnp.zeros(lanes)], axis=1)
    plants = dlx.systems.BouncingBall(), Fall()
    alone, gradients, batches = [], [], []
    for plant in plants:
        dynamics = dlx.Discretized(plant, dt=0.05)

        def last(x, dynamics=dynamics):
            return dlx.open_loop(dynamics, x, controls)[-1]

        def total(x, dynamics=dynamics):
            return jnp.sum(dlx.open_loop(dynamics, x, controls) ** 2)

        name = type(plant).__name__
        alone.append(compiled(name, steps, last, x0))
        gradients.append(compiled(name, steps, jax.value_and_grad(total), x0))
        batches.append(compiled(name, steps * lanes, jax.vmap(last), starts))
    found = []
    for what, contenders, limit in (
        ("one rollout", alone, None),
        ("its gradient", gradients, 3.0),
        ("1,024 balls at once", batches, 10.0),
    ):
        ball, fall = race(contenders, rounds=rounds)
        found.append(row(f"{what}, ns a step", ball.best))
        beside = f"{what}, relative to a run without events"
        found.append(row(beside, ball.ratio(fall), limit))
    return found


_BEGIN = """
import time, jax, jax.numpy as jnp, delucax as dlx
from delucax import Discretized, open_loop, systems
x, u = jnp.array([1.0, 0.0]), jnp.zeros((40, 1))
start = time.perf_counter()
dynamics = Discretized(systems.BouncingBall(), dt=0.05)
"""
_VALUE = "jax.block_until_ready(open_loop(dynamics, x, u))"
_GRADIENT = """
total = lambda x: jnp.sum(open_loop(dynamics, x, u) ** 2)
jax.block_until_ready(jax.jit(jax.grad(total))(x))
"""
_WALK = """
import time, jax, delucax as dlx
start = time.perf_counter()
env = dlx.make("compass_gait", horizon=24)
loss = dlx.training.expected_cost(env, batch=64)
policy = dlx.controllers.mlp_policy(env, width=32, depth=1, key=jax.random.key(0))
dlx.training.analytic(loss, policy, jax.random.key(1))
print(time.perf_counter() - start)
"""
_END = "\nprint(time.perf_counter() - start)"


def first_answer(quick: bool) -> list[dict[str, Any]]:
    """The seconds of a first rollout and of a first gradient in a fresh process, after
    the import."""
    times = 1 if quick else 5
    found = []
    for what, code in (("rollout", _VALUE), ("gradient", _GRADIENT)):
        seconds = [in_fresh_process(_BEGIN + code + _END) for _ in range(times)]
        found.append(row(f"first {what} [s]", np.median(seconds), 3.0))
    # The largest of the plants, in an episode of the task.
    seconds = [in_fresh_process(_WALK) for _ in range(times)]
    found.append(row("first gradient of a walker [s]", np.median(seconds)))
    return found


PARTS: dict[str, Any] = {
    **ACCURACY,
    "throw": throw,
    "walker": walker,
    "speed": speed,
    "first answer": first_answer,
}


def draw(content: dict[str, Any]) -> None:
    """Print all figures, and put those of accuracy, of the walker and of speed into the
    tables of the page."""
    for name in PARTS:
        rows = content[name]
        table = pd.DataFrame(rows["rows"] if isinstance(rows, dict) else rows)
        print(f"\n{name}\n{table.to_string(index=False)}")
    known = [found for name in ACCURACY for found in content[name]]
    tables = {
        "errors": [
            [found["what"], f"{found['measured']:.0e}", f"{found['limit']:.0e}"]
            for found in known
            if found["limit"] is not None
        ],
        "published": [
            [found["what"], _as(found["published"], found["measured"])]
            + [found["published"]]
            for found in known
            if found["published"] is not None
        ],
        "walker": [
            [found["walker"], *(str(found[key]) for key in WHOLE)]
            + [f"{found['seconds a step']:.2f}", f"{found['torque']:.1f}"]
            for found in content["walker"]["rows"]
        ],
        "cost": [
            [found["what"], f"{found['measured']:.2g}", f"{found['limit'] or '-'}"]
            for found in content["speed"]
            if "relative to" in found["what"]
        ],
    }
    text = PAGE.read_text()
    for name, rows in tables.items():
        begin, end = f"<!-- table: {name} -->\n", f"<!-- end: {name} -->"
        before, _, rest = text.partition(begin)
        table, _, after = rest.partition(end)
        head = table.strip().split("\n")[:2]
        lines = [*head, *(f"| {' | '.join(cells)} |" for cells in rows)]
        text = "\n".join([before + begin, *lines, "", end + after])
    PAGE.write_text(text)


def _as(published: str, measured: float) -> str:
    """A number with the digits of a published one, two decimals at least."""
    return f"{measured:.{max(len(published.partition('.')[2]), 2)}f}"


def main() -> None:
    """Run, print and write."""
    run_in_parts("events", PARTS, {}, RESULTS, draw)


if __name__ == "__main__":
    main()
