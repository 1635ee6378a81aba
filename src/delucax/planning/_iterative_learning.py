"""Iterative learning control, and a variant that also learns within each run."""

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
    check_range,
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
"""The regularisation is 0, then `LEAST_MU`, then grows by this factor until the problem
is convex, at most 1e10. The count is the number of tries."""
_RATE_DECAY = 0.01
"""The factor of the learning rate after a failed search of `igpc`."""


class _Online(NamedTuple):
    """The options of `igpc` for learning within a run."""

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
    r"""Iterative learning control: improve a plan by running it on the plant.

    Iterative learning control works like [`delucax.planning.ilqr`][], but the states
    and the costs come from runs of the plant, and only the derivatives come from the
    model. Each iteration

    1. linearises the model along the last run $\bar x$, $\bar u$ of the plant,
    2. solves the linear-quadratic problem,
    3. runs $u_k = \bar u_k - \alpha\, d_k - K_k\, (x_k - \bar x_k)$ on the plant, where
        the change $-d_k$ and the gain $K_k$ come from the solution of the
        linear-quadratic problem, for $\alpha = \alpha_\mathrm{last}\, 1.1^{1 - j^2}$
        with $j = 0, \dots, 9$, until a run costs at most as much as the last run.

    If all of these runs cost more than the last run, learning stops early. The final
    plan is close to the optimal plan of the plant. The distance between the two plans
    grows with the error of the model's derivatives. If the problem is not convex, the
    control Hessian is regularised until it is positive definite.

    **Arguments:**

    - `plant`: the true dynamics, which are simulated but not differentiated.
    - `model`: the dynamics to differentiate, with the same numbers of states and
        controls as the plant.
    - `cost`: the stage and final cost.
    - `plan`: the [`delucax.planning.Plan`][] to start from, made with the model. Each
        run uses the first state, the start time and the control bounds of this plan.
        The first run follows this plan with the feedback gains of the plan.
    - `w`: disturbances of the plant, the same in each run and unknown to the model,
        shape `(T, k)`; zero by default.
    - `iterations`: the largest number of iterations; 40 by default.
    - `step`: the value of $\alpha_\mathrm{last}$ in the first iteration; 1 by default.
    - `throw`: if true (default), raise an error if the first run diverges. If false,
        check the `result` yourself.

    **Returns:** a [`delucax.planning.Plan`][]: the best run of the plant, with feedback
    gains about this run.

    - `rollouts`: the number of runs, including the first run.
    - `trace`: the cost of the first run, and the cost after each iteration.
    - `residual`: the largest entry of the gradient, computed with the model's
        derivatives.
    - `result`: `successful` if all iterations were taken, `no_descent` if a line search
        failed before that, `diverged` if the first run diverged.

    **Raises:** `ValueError` if an argument has the wrong kind or shape or is out of its
    range; with `throw`, an error at run time if the first run diverges.

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
        learned.trace.round(1)
        ```

        ```text
        Array([59.8, 52.2, 51.6, 51.5, 51.5, 51.5], dtype=float32)
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
    r"""Iterative gradient perturbation control: like `ilc`, but it also learns during a
    run.

    The control law learns from the mismatch between plant and model. The control in a
    run is

    $$u_k = \bar u_k - \alpha\, d_k - K_k\, (x_k - \bar x_k)
    + \sum_{i=1}^M E_i\, w_{k-i} + o, \qquad w_k = x_{k+1} - F(t_k, x_k, u_k)$$

    where $F$ is the model, $w$ the mismatch and $M$ the `memory`. The first three terms
    are the same as in [`delucax.planning.ilc`][]. The control is clipped to the bounds.

    The parameters $E$ and $o$ are zero at the start of each run. From step `horizon`
    on, gradient descent updates both, with the step size `learning_rate / k` at step
    $k$. The updates lower a counterfactual cost. To compute it, `igpc` simulates the
    last `horizon` steps again on the model, with the present $E$ and $o$ and with the
    observed mismatch. The counterfactual cost is the last stage cost of this
    simulation. The next iteration linearises the model along this run, and therefore
    keeps what the run has learned.

    **Arguments:**

    - `plant`, `model`, `cost`, `plan`, `w`, `iterations`, `step`, `throw`: as for
        [`delucax.planning.ilc`][].
    - `learning_rate`: the learning rate, at least 0; 0.001 by default.
    - `memory`: the number $M$ of past disturbances; 3 by default.
    - `horizon`: the number of steps of the counterfactual cost; 3 by default.
    - `indices`: `"aligned"` (default) uses each disturbance at the step at which it
        acted; `"deluca"` uses each disturbance one step too early, as the original
        library does, and serves for comparison.
    - `anneal`: if true (default), a line search tries up to 6 step sizes until a run
        costs less than the last run. If no run costs less, the learning rate is divided
        by 100. If false, a line search tries up to 10 step sizes until a run costs at
        most as much as the last run. If all 10 runs cost more, learning stops.

    **Returns:** a [`delucax.planning.Plan`][]: the best run of the plant, with the
    applied controls, and with feedback gains about this run. The fields have the same
    meaning as for [`delucax.planning.ilc`][].

    **Raises:** `ValueError` if an argument has the wrong kind or shape or is out of its
    range; with `throw`, an error at run time if the first run diverges.

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
        learned.trace.round(3)
        ```

        ```text
        Array([1.879, 1.871, 1.870, 1.870, 1.870, 1.870], dtype=float32)
        ```
    """
    where = "igpc"
    check_number(learning_rate, "learning_rate", where)
    check_range(learning_rate, "learning_rate", where)
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
    """Check the arguments that `ilc` and `igpc` share, and iterate."""
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
    """The state of the loop."""

    last: tuple[Array, Array, Array]
    """The states, the controls and the cost of the run to improve."""
    policy: Policy
    """The policy from the model's derivatives along this run."""
    mu: Array
    """The regularisation of this policy."""
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
    """The learned plan, and the result of the first run, which follows `plan`.

    The second result does not count a failed search, with which learning usually ends.
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
    unchanged = jnp.zeros_like(plan.controls)
    first = roll_out(plant, *about, unchanged, zero)[:3]
    lost = ~jnp.isfinite(first[2])

    def policy_of(states, controls, before) -> tuple[Array, Policy]:
        """The policy from the model's derivatives along a run, with the smallest
        regularisation that makes the problem convex."""
        stages = local_model(model, states, controls, None, False)
        box = model.room(controls)

        def trial(tried):
            mu = LEAST_MU * jnp.asarray(_MU_GROWTH, dtype) ** (tried - 1)
            mu = jnp.where(tried > 0, mu, 0)
            policy = in_sequence(stages, mu, False, box)
            return (mu, policy), policy.ok

        return first_accepted(trial, _MU_COUNT, before)[1]

    def body(now):
        """Search along the last policy, then make the policy about the best run.

        The first pass has no policy, so it does not search. It is part of the loop so
        that this code is compiled once.
        """
        (states, controls, cost), policy = now.last, now.policy

        def trial(tried):
            # First try a longer step than the last one, then shorter ones. The factor
            # 1.1^(1 - j^2) is 1.1, 1, 0.75, 0.47, ..., as in the original library.
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
            # Without a learning rate to lower, a failed search would fail again.
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
    """A run of the plant under the policy and the terms that are learned online.

    Returns states, controls and cost, which is infinite if the run diverged.
    """
    memory, horizon, aligned = online
    controls, K = controls - length * policy.k, policy.K
    T, m = controls.shape
    n, dtype = plant.x0.shape[0], controls.dtype
    times = plant.times(T)

    def act(k, x, learned, w):
        """The control at step k. The newest disturbance in `w` is the last."""
        E, o = learned
        u = controls[k] - matvec(K[k], plant.deviation(x, states[k]))
        return plant.clip(u + jnp.einsum("imn,in->m", E, w) + o)

    def last_cost(learned, x, first, w):
        """The counterfactual cost: the last stage cost of a rollout of the model from
        step `first`, under the parameters `learned` and the observed disturbances."""
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
        # The mismatch w_k = x_{k+1} - F(t_k, x_k, u_k).
        left = plant.deviation(after, model.step(times[k], x, u, None))
        disturbances = jnp.concatenate([disturbances[1:], left[None]])
        visited = jnp.concatenate([visited[1:], x[None]])
        # `visited` holds the states of the steps k - horizon to k.
        late = int(aligned)
        first = jnp.maximum(k - horizon + late, 0)
        slope = jax.grad(last_cost)(learned, visited[late], first, disturbances)
        # Online gradient descent with steps of 1/k, when the history is complete.
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
