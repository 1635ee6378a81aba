"""Iterative gradient perturbation control."""

from typing import Any

import jax
import jax.lax as lax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array

from .._check import (
    check_bool,
    check_choice,
    check_count,
    check_number,
    check_positive,
)
from .._module import as_float_array
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ..math import matvec
from ._ilc import as_problems, learn, raise_if_diverged, Trials
from ._lq import Policy
from ._plan import Plan
from ._problem import Problem


SLOWER = 0.01


def igpc(
    plant: AbstractDynamics,
    model: AbstractDynamics,
    cost: AbstractCost,
    plan: Plan,
    *,
    w: Any = None,
    iterations: int = 40,
    step: Any = 1.0,
    learning_rate: Any = 0.001,
    memory: int = 3,
    horizon: int = 3,
    indices: str = "aligned",
    anneal: bool = True,
    throw: bool = True,
) -> Plan:
    """Iterative gradient perturbation control: iterative learning control in which each
    run learns online, too, from how the plant leaves the model:

    `u_t = u_last - a k - K (x_t - x_last) + sum_{i=1..memory} E_i w_{t-i} + o`, with
    `w_t = x_{t+1} - F(t, x_t, u_t)`, F being the model.

    E and o start at zero in each run, and follow at step t, by `learning_rate / t`, the
    gradient of the last cost of a roll-out of `horizon` steps, from a state that was
    met to the present one, through the model and what it left over. The next iteration
    linearises along the run, so what was learned within it stays. For the rest it is
    [`delucax.planning.ilc`][]. On the paper's quadrotor it needs fewer runs than
    that; over many winds, with the steps of both well chosen, it does not.

    **Arguments:**

    - `plant`: the true dynamics, which are only run.
    - `model`: the dynamics that are differentiated, of the same sizes.
    - `cost`: the stage and final cost.
    - `plan`: where to start, as in [`delucax.planning.ilc`][].
    - `w`: disturbances of the plant, the same in each run, of which the model does not
        know, shape `(T, k)`; zero by default.
    - `iterations`: 40 by default.
    - `step`: the first `a`, 1 by default.
    - `learning_rate`: 0.001 by default.
    - `memory`: the number of past disturbances, 3 by default.
    - `horizon`: of the roll-out, 3 by default.
    - `indices`: `"aligned"` (default), each disturbance at the step that it was met;
        or `"deluca"`, for comparison: one step early, as in the original library.
    - `anneal`: if true (default), a search tries six steps, of which one must lower the
        cost, or else the learning rate is divided by 100; if false, it tries ten, of
        which one must not raise it, or else it ends.
    - `throw`: raise if the first run diverges (default); if false, look at the
        `result`.

    **Returns:** a [`delucax.planning.Plan`][], as from [`delucax.planning.ilc`][]:
    the best run of the plant, what was learned within it included, and feedback about
    it.

    **Raises:** `ValueError` on an argument of the wrong kind or shape, or out of its
    range; an error at run time as `throw` says.

    Source: Agarwal, Hazan, Majumdar and Singh, 2021.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        model = dlx.make("planar_quadrotor")
        plant = dlx.make("planar_quadrotor", wind="dissipative", wind_strength=0.1)
        start = jnp.tile(model.dynamics.equilibrium()[1], (30, 1))
        x0 = model.initial_state
        plan = dlx.planning.ilqr(model.dynamics, model.cost, x0, start)
        learned = dlx.planning.igpc(
            plant.dynamics, model.dynamics, model.cost, plan, iterations=5
        )
        learned.trace
        ```
    """
    where = "igpc"
    problems = as_problems(plant, model, cost, plan, w, where)
    for name, value in (("step", step), ("learning_rate", learning_rate)):
        check_number(value, name, where)
        no_learning = name == "learning_rate" and isinstance(value, int | float)
        if not (no_learning and value == 0):
            check_positive(value, name, where)
    check_choice(indices, ("aligned", "deluca"), "indices", where)
    run = Partial(
        perturbed,
        memory=check_count(memory, "memory", where),
        horizon=check_count(horizon, "horizon", where),
        aligned=indices == "aligned",
    )
    iterations = check_count(iterations, "iterations", where)
    trials = Trials(iterations)
    if check_bool(anneal, "anneal", where):
        trials = Trials(iterations, candidates=6, strict=True, slower=SLOWER)
    rates = as_float_array(step), as_float_array(learning_rate)
    out = learn(*problems, plan, run, *rates, trials)
    return raise_if_diverged(out, where) if throw else out


def perturbed(
    plant: Problem,
    model: Problem,
    states: Array,
    controls: Array,
    policy: Policy,
    length: Array,
    rate: Array,
    *,
    memory: int,
    horizon: int,
    aligned: bool,
) -> tuple[Array, Array, Array]:
    """A run of the plant under the policy and what is learned online; its states,
    controls and cost, infinite if it diverged."""
    controls, K = controls - length * policy.k, policy.K
    T, m = controls.shape
    n, dtype = plant.x0.shape[0], controls.dtype
    times = plant.times(T)

    def act(k, x, learned, w):
        """The control at step k; `w` has the newest disturbance last."""
        E, o = learned
        u = controls[k] - matvec(K[k], plant.deviation(x, states[k]))
        return plant.clip(u + jnp.einsum("imn,in->m", E, w) + o)

    def last_cost(learned, x, first, w):
        """Of a roll-out through the model, from step `first`."""
        cost = jnp.zeros((), dtype)
        for j in range(horizon):
            k = first + j
            u = act(k, x, learned, w[j : j + memory])
            cost = model.cost(times[k], x, u)
            x = model.step(times[k], x, u, None) + w[j + memory]
        return cost

    def body(carry, inputs):
        x, learned, visited, disturbances = carry
        k, w_k = inputs
        u = act(k, x, learned, disturbances[horizon:])
        after = plant.step(times[k], x, u, w_k)
        left = plant.deviation(after, model.step(times[k], x, u, None))
        disturbances = jnp.concatenate([disturbances[1:], left[None]])
        visited = jnp.concatenate([visited[1:], x[None]])
        # `visited` holds the states of the steps k - horizon to k.
        late = int(aligned)
        first = jnp.maximum(k - horizon + late, 0)
        slope = jax.grad(last_cost)(learned, visited[late], first, disturbances)
        size = jnp.where(k >= horizon, rate / jnp.maximum(k, 1), 0)
        learned = jax.tree.map(lambda p, g: p - size * g, learned, slope)
        return (after, learned, visited, disturbances), (x, u)

    learned = jnp.zeros((memory, m, n), dtype), jnp.zeros(m, dtype)
    visited = jnp.broadcast_to(plant.x0, (horizon + 1, n))
    disturbances = jnp.zeros((horizon + memory, n), dtype)
    start = plant.x0, learned, visited, disturbances
    (last, *_), (before, applied) = lax.scan(body, start, (jnp.arange(T), plant.w))
    states = jnp.concatenate([before, last[None]])
    cost = plant.total(states, applied)
    good = jnp.isfinite(cost) & jnp.all(jnp.isfinite(states))
    return states, applied, jnp.where(good, cost, jnp.inf)
