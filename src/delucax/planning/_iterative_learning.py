"""Iterative learning control, and its variant that learns within each run, too."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._check import (
    check_bool,
    check_choice,
    check_count,
    check_instance,
    check_number,
    check_positive,
    finite_rows,
)
from .._module import as_float_array
from .._results import choose, Result, RESULTS
from ..costs import AbstractCost
from ..dynamics import AbstractDynamics
from ..math import matvec
from ._descent import first_accepted, LEAST_MU
from ._lq import in_sequence, model as local_model, Policy
from ._plan import Plan
from ._planner import checked_plan
from ._problem import Problem, roll_out


_MU_GROWTH, _MU_COUNT = 10.0, 18
"""The growth of the regularisation per pass, until the problem is convex, from 0 and
`LEAST_MU` to 1e10."""
_RATE_DECAY = 0.01
"""The factor of the learning rate after a failed search of `igpc`."""


class _Online(NamedTuple):
    """The options of the online learning within a run of `igpc`."""

    memory: int
    horizon: int
    aligned: bool


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
    changing it by the derivatives of a model that is not the plant.

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
    given = plant, model, cost, plan, w, iterations, step
    return _learned("ilc", *given, 0.0, None, False, throw)


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
    run learns online, too, from the model mismatch:

    `u_t = u_last - a k - K (x_t - x_last) + sum_{i=1..memory} E_i w_{t-i} + o`, with
    `w_t = x_{t+1} - F(t, x_t, u_t)`, F being the model.

    E and o start at zero in each run. At step t they descend, with rate
    `learning_rate / t`, along the gradient of a counterfactual cost: the last one of
    `horizon` steps through the model, with the observed mismatch added. The next
    iteration linearises along the run, so what was learned within it stays. Otherwise
    it is identical to [`delucax.planning.ilc`][].

    **Arguments:**

    - `plant`, `model`, `cost`, `plan`, `w`, `iterations`, `step`, `throw`: as in
        [`delucax.planning.ilc`][].
    - `learning_rate`: 0.001 by default.
    - `memory`: the number of past disturbances, 3 by default.
    - `horizon`: the steps of the counterfactual cost, 3 by default.
    - `indices`: `"aligned"` (default), each disturbance at the step that it was met;
        or `"deluca"`, for comparison: one step early, as in the original library.
    - `anneal`: if true (default), a search tries up to 6 steps until one lowers the
        cost, and divides the learning rate by 100 if none does. If false, it tries up
        to 10 steps until one does not raise the cost, and stops if all do.

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

        env = dlx.make("pendulum")
        heavier = dlx.replace(env.dynamics, {"system.mass": 1.2})
        x0 = jnp.array([0.5, 0.0])
        plan = dlx.planning.ilqr(env.dynamics, env.cost, x0, 20)
        learned = dlx.planning.igpc(
            heavier, env.dynamics, env.cost, plan, iterations=5
        )
        learned.trace
        ```
    """
    where = "igpc"
    check_number(learning_rate, "learning_rate", where)
    # A rate of zero is valid: only the feedback acts then.
    if not (isinstance(learning_rate, int | float) and learning_rate == 0):
        check_positive(learning_rate, "learning_rate", where)
    check_choice(indices, ("aligned", "deluca"), "indices", where)
    online = _Online(
        check_count(memory, "memory", where),
        check_count(horizon, "horizon", where),
        aligned=indices == "aligned",
    )
    check_bool(anneal, "anneal", where)
    given = plant, model, cost, plan, w, iterations, step
    return _learned(where, *given, learning_rate, online, anneal, throw)


def _learned(
    where, plant, model, cost, plan, w, iterations, step, rate, online, anneal, throw
) -> Plan:
    """Check what both kinds take, and iterate."""
    models = ("plant", plant), ("model", model)
    for name, dynamics in models:
        check_instance(dynamics, AbstractDynamics, name, where)
    check_instance(cost, AbstractCost, "cost", where)
    check_instance(plan, Plan, "plan", where, ", such as ilqr makes")
    T, m = plan.controls.shape
    sizes = plan.states.shape[1], m
    for name, dynamics in models:
        got = dynamics.state_size, dynamics.control_size
        if got != sizes:
            raise ValueError(
                f"{where}: {name} must have the states and controls of plan, {sizes}, "
                f"got {got}."
            )
    if w is not None:
        w = finite_rows(w, plant.disturbance_size, "w", where, T)
    iterations = check_count(iterations, "iterations", where)
    check_number(step, "step", where)
    check_positive(step, "step", where)
    rates = as_float_array(step), as_float_array(rate)
    given = plant, model, cost, plan, w
    out, failure = _iterate(*given, *rates, iterations, online, bool(anneal))
    if not throw:
        return out
    checked = checked_plan(eqx.tree_at(lambda p: p.result, out, failure), where)
    return eqx.tree_at(lambda p: p.result, checked, out.result)


class _Progress(NamedTuple):
    last: tuple[Array, Array, Array]
    """States, controls and cost of the run to improve."""
    policy: Policy
    """The policy by the model's derivatives along that run."""
    mu: Array
    """The regularisation of that policy."""
    step: Array
    rate: Array
    runs: Array
    trace: Array
    iteration: Array
    started: Array
    """Whether there is a policy to try."""
    done: Array


@eqx.filter_jit
def _iterate(
    plant, model, cost, plan, w, step, rate, iterations, online, anneal
) -> tuple[Plan, Result]:
    """The plan after iterations from the first run, which follows the feedback of
    `plan`; and whether that run diverged.

    That a search failed is no failure here, but how learning usually ends.
    """
    dtype = plan.controls.dtype
    zero, bounds = jnp.zeros((), dtype), None
    about = plan.states.astype(dtype), plan.controls, plan.gains.astype(dtype)
    if plan.low is not None and plan.high is not None:
        bounds = plan.low, plan.high
    # The model has no disturbance: `w` is part of the model mismatch.
    given = cost, about[0][0], plan.t0.astype(dtype)
    plant = Problem(plant, *given, w, bounds, plan.difference)
    model = dataclasses.replace(plant, dynamics=model, w=None)
    # The first run follows the plan's own feedback, without a change.
    unchanged = jnp.zeros_like(plan.controls)
    first = roll_out(plant, *about, unchanged, zero)[:3]
    lost = ~jnp.isfinite(first[2])

    def policy_of(states, controls, before) -> tuple[Array, Policy]:
        """The regularisation and the policy by the model's derivatives along a run of
        the plant, the least one tried that makes the problem convex."""
        stages = local_model(model, states, controls, None, False)
        box = model.room(controls)

        def trial(tried):
            mu = LEAST_MU * jnp.asarray(_MU_GROWTH, dtype) ** (tried - 1)
            mu = jnp.where(tried > 0, mu, 0)
            policy = in_sequence(stages, mu, False, box)
            return (mu, policy), policy.ok

        return first_accepted(trial, _MU_COUNT, before)[1]

    def body(now):
        """A search along the last policy, and the policy about where it led. The first
        pass has none to search along: the loop has one body, so that it is compiled
        once."""
        (states, controls, cost), policy = now.last, now.policy

        def trial(tried):
            # One try above the last step, then ever shorter ones: 1.1^(1 - j^2) for
            # j = 0, 1, ... is 1.1, 1, 0.75, 0.47, ..., as in the original library.
            power = 1.0 - tried.astype(dtype) ** 2
            length = now.step * jnp.asarray(1.1, dtype) ** power
            if online is None:
                along = states, controls, policy.K, policy.k, length
                after = roll_out(plant, *along)[:3]
            else:
                rest = states, controls, policy, length, now.rate, online
                after = _perturbed(plant, model, *rest)
            good = after[2] < cost if anneal else after[2] <= cost
            return (length, after), good

        last = now.step, now.last
        most = jnp.where(now.started, 6 if anneal else 10, 0)
        tried, (length, after), good = first_accepted(trial, most, last)
        keep = lambda new, old: jnp.where(good, new, old)
        after = jax.tree.map(keep, after, now.last)
        failed = now.started & ~good
        iteration = now.iteration + now.started
        ended = lost | (iteration >= iterations)
        mu, policy = policy_of(*after[:2], (now.mu, policy))
        return _Progress(
            last=after,
            policy=policy,
            mu=mu,
            step=keep(length, now.step),
            rate=jnp.where(failed, _RATE_DECAY * now.rate, now.rate),
            runs=now.runs + tried,
            trace=now.trace.at[iteration].set(after[2]),
            iteration=iteration,
            started=~lost,
            # Without a rate to lower, a failed search would only fail again.
            done=ended if anneal else ended | failed,
        )

    step, rate = (jnp.asarray(number, dtype) for number in (step, rate))
    trace, count = jnp.full((iterations + 1,), first[2]), jnp.asarray(0)
    no = jnp.asarray(False)
    policy = Policy(about[2], unchanged, unchanged, zero, zero, zero, no)
    start = _Progress(
        first, policy, zero, step, rate, count + 1, trace, count, started=no, done=no
    )
    end = lax.while_loop(lambda now: ~now.done, body, start)
    states, controls, cost = end.last
    reached = jnp.arange(iterations + 1) <= end.iteration
    early = end.iteration < iterations
    result = choose(early, RESULTS.no_descent, RESULTS.successful)
    learned = plant.plan(
        states,
        controls,
        cost,
        gains=end.policy.K,
        trace=jnp.where(reached, end.trace, cost),
        residual=jnp.max(jnp.abs(end.policy.gradient)),
        result=choose(lost, RESULTS.diverged, result),
        iterations=end.iteration,
        rollouts=end.runs,
        regularisation=end.mu,
    )
    return learned, choose(lost, RESULTS.diverged, RESULTS.successful)


def _perturbed(plant, model, states, controls, policy, length, rate, online):
    """A run of the plant under the policy and what is learned online; its states,
    controls and cost, infinite if it diverged."""
    memory, horizon, aligned = online
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
        """The counterfactual cost: the last one of a rollout through the model, from
        step `first`, as if `learned` had acted in it, with the observed disturbances.
        """
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
        # w_t = x_{t+1} - F(t, x_t, u_t): all that the model did not foresee.
        left = plant.deviation(after, model.step(times[k], x, u, None))
        disturbances = jnp.concatenate([disturbances[1:], left[None]])
        visited = jnp.concatenate([visited[1:], x[None]])
        # `visited` holds the states of the steps k - horizon to k.
        late = int(aligned)
        first = jnp.maximum(k - horizon + late, 0)
        slope = jax.grad(last_cost)(learned, visited[late], first, disturbances)
        # Online gradient descent with steps of 1/t, from the first full history on.
        size = jnp.where(k >= horizon, rate / jnp.maximum(k, 1), 0)
        learned = jax.tree.map(lambda p, g: p - size * g, learned, slope)
        return (after, learned, visited, disturbances), (x, u)

    learned = jnp.zeros((memory, m, n), dtype), jnp.zeros(m, dtype)
    visited = jnp.broadcast_to(plant.x0, (horizon + 1, n))
    # The cost looks back `horizon` steps, whose controls look back `memory` more.
    disturbances = jnp.zeros((horizon + memory, n), dtype)
    start = plant.x0, learned, visited, disturbances
    (last, *_), (before, applied) = lax.scan(body, start, (jnp.arange(T), plant.w))
    states = jnp.concatenate([before, last[None]])
    cost = plant.total(states, applied)
    good = jnp.isfinite(cost) & jnp.all(jnp.isfinite(states))
    return states, applied, jnp.where(good, cost, jnp.inf)
