"""Iterative learning control, and its variant that learns within each run, too."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Array

from .._check import (
    check_bool,
    check_choice,
    check_count,
    check_instance,
    check_number,
    check_positive,
)
from .._module import as_float_array
from .._results import choose, RESULTS
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ..math import matvec
from ._descent import first_accepted, LEAST_MU, MOST_MU
from ._lq import in_sequence, Policy
from ._planner import checked_plan, finite_rows, Plan, plan_of
from ._problem import model as local_model, Problem, roll_out


GROWTH = 10.0
"""Of the regularisation, from pass to pass, until the problem is convex."""
SLOWER = 0.01
"""What a failed search of `igpc` multiplies the learning rate by."""


class Trials(NamedTuple):
    """What is fixed when an iterative learner is compiled."""

    iterations: int
    candidates: int = 10  # of a search
    strict: bool = False  # whether a trial must be better, not only as good
    slower: float | None = None
    """What a failed search multiplies the learning rate by. If none, it is the end."""


def ilc(
    plant: AbstractDynamics,
    model: AbstractDynamics,
    cost: AbstractCost,
    plan: Plan,
    *,
    w: Any = None,
    iterations: int = 40,
    step: Any = 1.0,
    throw: bool = True,
) -> Plan:
    """Iterative learning control: improve a plan by running it on the plant, and
    learning from a model that is not the plant how to change it.

    Each iteration linearises the model along the last run of the plant, solves the
    linear-quadratic problem, and runs `u - a k - K (x - x_last)` on the plant, for
    `a = 1.1 a_last 1.1^(-j^2)`, `j = 0, ..., 9`, until a run costs no more than the
    last one. If none does, it ends. It is [`delucax.planning.ilqr`][] in which only the
    derivatives come from the model, so it ends near the best for the plant, at a
    distance that grows with how wrong those are. Where the problem is not convex, the
    control Hessian is regularised as much as that takes.

    **Arguments:**

    - `plant`: the true dynamics, which are only run.
    - `model`: the dynamics that are differentiated, of the same sizes.
    - `cost`: the stage and final cost.
    - `plan`: where to start: a [`delucax.planning.Plan`][] made with the model. Its
        first state, time and bounds are those of each run, and the first run follows
        its feedback.
    - `w`: disturbances of the plant, the same in each run, of which the model does not
        know, shape `(T, k)`; zero by default.
    - `iterations`: 40 by default.
    - `step`: the first `a`, 1 by default.
    - `throw`: raise if the first run diverges (default); if false, look at the
        `result`.

    **Returns:** a [`delucax.planning.Plan`][]: the best run of the plant, and feedback
    about it. Its `rollouts` are the runs, the first one included; its `trace` the costs
    of the first run and after each iteration; its `residual` the gradient by the model.
    Its `result` is success if all iterations were taken, `no_descent` if a search
    failed before, and `diverged` if the first run did.

    **Raises:** `ValueError` on an argument of the wrong kind or shape, or out of its
    range; an error at run time as `throw` says.

    Source: Abbeel, Quigley and Ng, 2006; Agarwal, Hazan, Majumdar and Singh, 2021.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        model = dlx.make("planar_quadrotor")
        plant = dlx.make("planar_quadrotor", wind="dissipative", wind_strength=0.1)
        start = jnp.tile(model.dynamics.equilibrium()[1], (30, 1))
        x0 = model.initial_state
        plan = dlx.planning.ilqr(model.dynamics, model.cost, x0, start)
        learned = dlx.planning.ilc(
            plant.dynamics, model.dynamics, model.cost, plan, iterations=5
        )
        learned.trace
        ```
    """
    where = "ilc"
    problems = as_problems(plant, model, cost, plan, w, where)
    check_number(step, "step", where)
    check_positive(step, "step", where)
    trials = Trials(check_count(iterations, "iterations", where))
    rates = as_float_array(step), jnp.zeros(())
    out = learn(*problems, plan, _run_feedback, *rates, trials)
    return raise_if_diverged(out, where) if throw else out


def _run_feedback(
    plant: Problem,
    model: Problem,
    states: Array,
    controls: Array,
    policy: Policy,
    length: Array,
    rate: Array,
) -> tuple[Array, Array, Array]:
    """A run of the plant under the policy alone."""
    del model, rate
    return roll_out(plant, states, controls, policy.K, policy.k, length)


class _Progress(NamedTuple):
    last: tuple[Array, Array, Array]
    """States, controls and cost of the run to improve."""
    step: Array
    rate: Array
    runs: Array
    trace: Array
    iteration: Array
    done: Array


@eqx.filter_jit
def learn(
    plant: Problem,
    model: Problem,
    plan: Plan,
    run: Callable[..., tuple[Array, Array, Array]],
    step: Array,
    rate: Array,
    trials: Trials,
) -> Plan:
    """Iterate from the first run. `run(plant, model, states, controls, policy, length,
    rate)` runs the plant about the last run, and gives states, controls and cost."""
    dtype = plan.controls.dtype
    zero = jnp.zeros((), dtype)
    about = plan.states.astype(dtype), plan.controls, plan.gains.astype(dtype)
    first = roll_out(plant, *about, jnp.zeros_like(plan.controls), zero)
    lost = ~jnp.isfinite(first[2])

    def policy_of(states, controls) -> tuple[Array, Policy]:
        stages = local_model(model, states, controls, None, False)
        box = model.room(controls)

        def regularised(mu):
            return mu, in_sequence(stages, mu, False, box)

        def more(tried):
            return regularised(jnp.maximum(LEAST_MU, GROWTH * tried[0]))

        def concave(tried):
            return ~tried[1].ok & (tried[0] < MOST_MU)

        return lax.while_loop(concave, more, regularised(zero))

    def body(now):
        states, controls, cost = now.last
        _, policy = policy_of(states, controls)

        def trial(tried):
            length = now.step * jnp.asarray(1.1, dtype) ** (
                1.0 - tried.astype(dtype) ** 2
            )
            after = run(plant, model, states, controls, policy, length, now.rate)
            good = after[2] < cost if trials.strict else after[2] <= cost
            return (length, after), good

        given = trial, trials.candidates, (now.step, now.last)
        tried, (length, after), good = first_accepted(*given)
        keep = lambda new, old: jnp.where(good, new, old)
        after = jax.tree.map(keep, after, now.last)
        iteration = now.iteration + 1
        rate, ended = now.rate, iteration >= trials.iterations
        if trials.slower is None:
            ended = ended | ~good
        else:
            rate = keep(rate, trials.slower * rate)
        trace = now.trace.at[iteration].set(after[2])
        step, runs = keep(length, now.step), now.runs + tried
        return _Progress(after, step, rate, runs, trace, iteration, ended)

    start = _Progress(
        last=first,
        step=jnp.asarray(step, dtype),
        rate=jnp.asarray(rate, dtype),
        runs=jnp.asarray(1),
        trace=jnp.full((trials.iterations + 1,), first[2]),
        iteration=jnp.asarray(0),
        done=lost,
    )
    end = lax.while_loop(lambda now: ~now.done, body, start)
    states, controls, cost = end.last
    mu, policy = policy_of(states, controls)
    reached = jnp.arange(trials.iterations + 1) <= end.iteration
    result = choose(
        end.iteration < trials.iterations, RESULTS.no_descent, RESULTS.successful
    )
    return plan_of(
        plant,
        states,
        controls,
        cost,
        gains=policy.K,
        trace=jnp.where(reached, end.trace, cost),
        residual=jnp.max(jnp.abs(policy.gradient)),
        result=choose(lost, RESULTS.diverged, result),
        iterations=end.iteration,
        rollouts=end.runs,
        regularisation=mu,
    )


def raise_if_diverged(plan: Plan, where: str) -> Plan:
    """Raise if the first run diverged. That a search failed is no failure here."""
    fine = choose(plan.result == RESULTS.diverged, RESULTS.diverged, RESULTS.successful)
    checked = checked_plan(eqx.tree_at(lambda p: p.result, plan, fine), where)
    return eqx.tree_at(lambda p: p.result, checked, plan.result)


def as_problems(
    plant: Any, model: Any, cost: Any, plan: Any, w: Any, where: str
) -> tuple[Problem, Problem]:
    """The problems of the plant and of its model, or an error."""
    for name, dynamics in (("plant", plant), ("model", model)):
        check_instance(dynamics, AbstractDynamics, name, where)
    check_instance(cost, AbstractCost, "cost", where)
    check_instance(plan, Plan, "plan", where, ", such as ilqr makes")
    T, m = plan.controls.shape
    sizes = plan.states.shape[1], m
    for name, dynamics in (("plant", plant), ("model", model)):
        got = dynamics.state_size, dynamics.control_size
        if got != sizes:
            raise ValueError(
                f"{where}: {name} must have the states and controls of plan, {sizes}, "
                f"got {got}."
            )
    if w is not None:
        w = finite_rows(w, plant.disturbance_size, "w", where, T)
    x0 = plan.states[0].astype(plan.controls.dtype)
    t0, bounds = plan.t0.astype(x0.dtype), None
    if plan.low is not None and plan.high is not None:
        bounds = plan.low, plan.high
    problem = lambda dynamics, w: Problem(
        dynamics, cost, x0, t0, w, bounds, plan.difference
    )
    return problem(plant, w), problem(model, None)


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
