"""A search for the disturbances that cost a controller most."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from .._check import as_vector, check_count, check_instance, check_key, check_positive
from .._controller import AbstractController, check_controller
from .._module import as_float_array
from .._typing import PRNGKey
from ..environments import Environment
from ..math import safe_norm
from ..simulation import rollout


class Attack(NamedTuple):
    """The worst disturbances of a search.

    - `w`: shape `(horizon, k)`, for `rollout(..., w=w)`.
    - `total_cost`: what they cost.
    - `costs`: the total cost at each iteration from that start, shape
      `(iterations + 1,)`.

    [`delucax.training.worst_case`][] returns it.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        feedback = dlx.controllers.Linear([[20.0, 5.0]])
        options = dict(bound=0.01, x0=[0.1, 0.0], horizon=30, iterations=5)
        search = dlx.training.worst_case
        attack = search(env, feedback, key=jax.random.key(0), **options)
        attack.w.shape, attack.costs
        ```
    """

    w: Array
    total_cost: Array
    costs: Array


def worst_case(
    environment: Environment,
    controller: AbstractController,
    *,
    key: PRNGKey,
    bound: Any,
    x0: Any = None,
    horizon: int | None = None,
    iterations: int = 20,
    starts: int = 8,
) -> Attack:
    r"""Bounded disturbances that cost a controller as much as a local search can find,

    `max over w of the total cost, with |w_t| <= bound for each t`.

    At each iteration the cost is taken to be linear in the disturbances,
    `w_t <- bound g_t / |g_t|`, `g_t` being the derivative of the total cost with
    respect to `w_t`. Where the cost is convex in the disturbances, as with linear
    dynamics and feedback and a convex cost, no iteration makes it less; the best one is
    returned in any case. The search starts several times at once, every other time from
    a constant push and else from noise, and the best end is returned.

    **Arguments:**

    - `environment`: the environment; its own disturbance is not used.
    - `controller`: the controller under attack. A learner is attacked with all that it
        would learn.
    - `key`: a random key, for the start of the search, of the rollout and of the
        controller.
    - `bound`: of the Euclidean norm of each `w_t`, a positive number.
    - `x0`: the first state; drawn by the environment by default.
    - `horizon`: steps; the environment's own by default.
    - `iterations`: 20 by default.
    - `starts`: 8 by default.

    **Returns:** [`delucax.training.Attack`][].

    **Raises:** `ValueError` on an argument of the wrong kind, shape or range, or if the
    environment takes no disturbance.

    Source: Frank and Wolfe, 1956 (for a maximum of a convex function).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        env = dlx.make("lds", A=A, B=B, horizon=100)
        learner = dlx.controllers.gpc(env.dynamics, env.cost)
        attack = dlx.training.worst_case(env, learner, key=jax.random.key(0), bound=1.0)
        again = dlx.rollout(env, learner, key=jax.random.key(1), w=attack.w)
        attack.total_cost
        ```
    """
    where = "worst_case"
    check_instance(environment, Environment, "environment", where)
    check_controller(controller, "controller", where)
    if environment.disturbance_size == 0:
        raise ValueError(f"{where}: environment must take a disturbance, got none.")
    key = check_key(key, where)
    check_positive(bound, "bound", where)
    horizon = environment.horizon if horizon is None else horizon
    horizon = check_count(horizon, "horizon", where)
    iterations = check_count(iterations, "iterations", where)
    starts = check_count(starts, "starts", where)
    if x0 is not None:
        x0 = as_vector(x0, environment.state_size, "x0", where)
    bound = as_float_array(bound)
    sizes = horizon, iterations, starts
    return _attack(environment, controller, key, bound, x0, *sizes)


@eqx.filter_jit
def _attack(environment, controller, key, bound, x0, horizon, iterations, starts):
    start, run_key = jr.split(key)

    def total(w):
        options: Any = dict(key=run_key, horizon=horizon, x0=x0, keep=(), throw=False)
        return rollout(environment, controller, w=w, **options).total_cost

    def on_sphere(g, old):
        norm = safe_norm(g, keepdims=True)
        moved = (norm > 0) & jnp.isfinite(norm)
        return jnp.where(moved, bound * g / jnp.where(moved, norm, 1), old)

    def step(carry, _):
        w, best, most = carry
        cost, g = jax.value_and_grad(total)(w)
        better = cost > most
        best, most = jnp.where(better, w, best), jnp.where(better, cost, most)
        return (on_sphere(g, w).astype(w.dtype), best, most), cost

    @jax.vmap
    def search(w):
        carry = w, w, jnp.asarray(-jnp.inf, like.dtype)
        (w, best, most), costs = lax.scan(step, carry, length=iterations)
        last = total(w)
        better = last > most
        costs = jnp.append(costs, last)
        return Attack(jnp.where(better, w, best), jnp.maximum(last, most), costs)

    shape = horizon, environment.disturbance_size
    like = jax.eval_shape(total, jnp.zeros(shape))
    noise = jr.normal(start, (starts, *shape), like.dtype)
    steady = (jnp.arange(starts) % 2 == 0)[:, None, None]
    first = jnp.where(steady, noise[:, :1], noise)
    attacks = search(on_sphere(first, first).astype(like.dtype))
    worst = jnp.argmax(attacks.total_cost)
    return jax.tree.map(lambda leaf: leaf[worst], attacks)
