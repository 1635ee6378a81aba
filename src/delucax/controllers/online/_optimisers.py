"""The steps of online learners."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..._check import check_positive


def projected_step(owner: Any, gradient: PyTree, state: Any, **extra: Any) -> Any:
    """The state of a learner (`owner`) whose `theta` and `optimiser` have made a step;
    where that is not finite, they stay as they are and the step is counted as
    `refused`. `extra` is for the optimisers that take more than a gradient."""
    optimiser = optax.with_extra_args_support(owner.optimiser)
    rate = extra["learning_rate"] = owner.learning_rate
    before = state.theta, state.optimiser
    step, after = optimiser.update(gradient, state.optimiser, state.theta, **extra)
    add = lambda old, step: old + (rate * step).astype(old.dtype)
    # Projected after the step (Zinkevich, 2003): the bound on the regret needs the set.
    new = owner.policy.project(jax.tree.map(add, state.theta, step)), after
    floats = jax.tree.leaves(eqx.filter(new, eqx.is_inexact_array))
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in floats]))
    keep = lambda new, old: jnp.where(finite, new, old)
    theta, after = jax.tree.map(keep, new, before)
    refused = state.refused.add(~finite)
    return state._replace(theta=theta, optimiser=after, refused=refused)


def _adagrad_norm_init(params: PyTree) -> Array:
    """The sum of the squared norms of all gradients so far."""
    return jnp.zeros((), jax.tree.leaves(params)[0].dtype)


def _adagrad_norm_update(
    updates: Any, state: Any, params: Any = None
) -> tuple[PyTree, Array]:
    del params
    # One step size for all weights, from a sum that includes this gradient: so no step
    # is longer than the learning rate, not even the first.
    total = state + optax.tree.norm(updates, squared=True)
    some = total > 0
    scale = jnp.where(some, 1 / jnp.sqrt(jnp.where(some, total, 1)), 0)
    return jax.tree.map(lambda g: -scale.astype(g.dtype) * g, updates), total


_ADAGRAD_NORM = optax.GradientTransformation(_adagrad_norm_init, _adagrad_norm_update)


def adagrad_norm() -> optax.GradientTransformation:
    r"""Gradient descent whose step does not depend on the scale of the loss,

    `theta_next = theta - learning_rate g_t / sqrt(sum_{s <= t} |g_s|^2)`,

    with `learning_rate` that of the learner. With convex losses and a set of diameter D
    its regret is at most `(D^2 / (2 learning_rate) + learning_rate) sqrt(sum |g|^2)`,
    without knowing how large gradients will be or how many there are.

    **Returns:** an `optax.GradientTransformation`, the same at each call, so that two
    learners share what was compiled.

    Source: Streeter and McMahan, 2010; Ward, Wu and Bottou, 2019.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        import optax

        optimiser = dlx.controllers.adagrad_norm()
        state = optimiser.init(jnp.zeros(2))
        step, state = optimiser.update(jnp.array([3.0, 4.0]), state)
        optax.apply_updates(jnp.zeros(2), step)
        ```
    """
    return _ADAGRAD_NORM


class OnlineNewtonState(NamedTuple):
    """A root of the inverse of the curvature so far with its prior; the sum of the
    traces of what was added to it, and how many times something was."""

    root: Float[Array, "d d"]
    total: Float[Array, ""]
    count: Float[Array, ""]


def _online_newton_init(params: PyTree) -> OnlineNewtonState:
    flat, _ = ravel_pytree(params)
    zero = jnp.zeros((), flat.dtype)
    return OnlineNewtonState(jnp.zeros((flat.size, flat.size), flat.dtype), zero, zero)


class _OnlineNewtonUpdate(eqx.Module):
    """A module, so that it can be saved and two for one prior are equal."""

    prior: float = eqx.field(static=True)

    def __call__(
        self,
        updates: Any,
        state: Any,
        params: Any = None,
        *,
        curvature: Callable[[], Array] | None = None,
        learning_rate: Array | float = 1.0,
        **others: Any,
    ) -> tuple[PyTree, OnlineNewtonState]:
        del params, others
        if curvature is None:
            raise ValueError(
                "online_newton: update must be given the curvature of the loss, which "
                "OnlineLearner knows and BPC, which sees the cost alone, does not."
            )
        gradient, unravel = ravel_pytree(updates)
        factor = curvature()
        root, total, count = state
        size = jnp.sum(factor**2)
        # Where this update is larger than all before it by 1 / sqrt(eps), they would be
        # lost in rounding: start anew.
        first = size > total / jnp.sqrt(jnp.finfo(size.dtype).eps)
        total, count = jnp.where(first, 0, total), jnp.where(first, 0, count)
        new_total, new_count = total + size, count + (size > 0)
        # Until the prior is outweighed it is worth `prior` of the average step so far.
        mean = lambda total, count: total / jnp.where(count > 0, count, 1)  # noqa: E731
        early = (size > 0) & (count > 0) & (count < self.prior)
        # The prior: a multiple of the identity with the trace of `prior` average
        # updates.
        fresh = gradient.size / (self.prior * jnp.where(first, size, 1))
        fresh = jnp.sqrt(fresh) * jnp.eye(gradient.size, dtype=gradient.dtype)
        after = jnp.where(early, mean(new_total, new_count), 1)
        scale = jnp.sqrt(jnp.where(early, mean(total, count) / after, 1))
        root = jnp.where(first, fresh, scale * root)
        # Sherman and Morrison's P - P c c'P / (1 + c'P c) for each column c, on a root
        # of P: Potter's form stays positive whatever the rounding.
        for column in factor.T:
            along = column @ root
            gain = 1 + along @ along
            root = root - jnp.outer(root @ along, along) / (gain + jnp.sqrt(gain))
        # P g = root root' g. `projected_step` multiplies by the learning rate, but
        # Newton's step has a length of its own: it is divided out.
        step = root @ (gradient @ root) / learning_rate
        # A trust region of radius 1 (times the learning rate): early curvature is a
        # guess.
        squared = jnp.sum(step**2)
        long = squared > 1
        step = step * jnp.where(long, 1 / jnp.sqrt(jnp.where(long, squared, 1)), 1)
        return unravel(-step), OnlineNewtonState(root, new_total, new_count)


def online_newton(prior: float = 100.0) -> optax.GradientTransformation:
    r"""Newton's step with all the curvature so far,

    `theta_next = theta - P_t g_t`, `P_t^-1 = prior c I + sum_{s <= t} J_s' H_s J_s`,

    no longer than `learning_rate`, that of the learner. J_s is the derivative of the
    observation and control of step s by theta, H_s the curvature of the cost at them
    (its positive part, where the cost is not convex), and c the mean curvature of a
    weight over the first `prior` steps that have any: so the prior weighs as much as
    that many steps, whatever the scales of cost, disturbance and weights. With
    quadratic costs it is recursive least squares, and its regret grows as `log(T)`.

    Only an [`delucax.controllers.OnlineLearner`][] can use it: it hands the curvature
    over. The state has a number for each pair of weights, and a step takes as many
    operations.

    **Arguments:** `prior`: steps, 100 by default. A small one learns fast where the
    features are much alike, a large one keeps noise out of what is learned.

    **Returns:** an `optax.GradientTransformationExtraArgs`; those of one prior are
    equal, so that two learners share what was compiled.

    **Raises:** `ValueError` if `prior` is not positive; when it is used, if it is not
    given the curvature.

    Source: Simchowitz, 2020; Hazan, Agarwal and Kale, 2007; Potter, 1963 (the form).

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("lds", key=jax.random.key(0))
        optimiser = dlx.controllers.online_newton(prior=20.0)
        learner = dlx.controllers.gpc(env.dynamics, env.cost, optimiser=optimiser)
        dlx.rollout(env, learner, key=jax.random.key(0)).total_cost
        ```
    """
    check_positive(prior, "prior", "online_newton")
    return optax.GradientTransformationExtraArgs(
        _online_newton_init, _OnlineNewtonUpdate(float(prior))
    )


def positive_root(H: Float[Array, "z z"]) -> Float[Array, "z z"]:
    """The Cholesky factor of the positive part of a symmetric matrix; columns that
    have no positive pivot are zero."""
    # Pivots below are rounding, and their square roots would be noise.
    slack = len(H) * jnp.finfo(H.dtype).eps * jnp.max(jnp.abs(jnp.diag(H)), initial=0)

    # Cholesky's factorisation column by column, in Python: the sizes are those of y and
    # u, and a pivot that is not positive is left out instead of making NaN.
    columns = []
    for j in range(len(H)):
        pivot = H[j, j]
        positive = pivot > slack
        column = H[:, j] / jnp.sqrt(jnp.where(positive, pivot, 1))
        columns.append(jnp.where(positive, column, 0))
        H = H - jnp.outer(columns[-1], columns[-1])
    return jnp.stack(columns, axis=1)
