"""The optimisers of online learners."""

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
    """The state of a learner (`owner`) after a step of its optimiser and a projection.

    If the result is not finite, `theta` and `optimiser` stay the same, and the step is
    counted in `refused`. `extra` holds further arguments for the optimiser.
    """
    optimiser = optax.with_extra_args_support(owner.optimiser)
    rate = extra["learning_rate"] = owner.learning_rate
    before = state.theta, state.optimiser
    step, after = optimiser.update(gradient, state.optimiser, state.theta, **extra)
    add = lambda old, step: old + (rate * step).astype(old.dtype)
    # The projection is needed for the bound on the regret (Zinkevich, 2003).
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
    # The sum includes this gradient, so that no step is longer than the learning rate.
    total = state + optax.tree.norm(updates, squared=True)
    some = total > 0
    scale = jnp.where(some, 1 / jnp.sqrt(jnp.where(some, total, 1)), 0)
    return jax.tree.map(lambda g: -scale.astype(g.dtype) * g, updates), total


_ADAGRAD_NORM = optax.GradientTransformation(_adagrad_norm_init, _adagrad_norm_update)


def adagrad_norm() -> optax.GradientTransformation:
    r"""Gradient descent whose step does not depend on the scale of the loss.

    $$\theta_{t+1} = \theta_t - \eta\, \frac{g_t}{\sqrt{\sum_{s \le t} |g_s|^2}}$$

    Here $\eta$ is the `learning_rate` of the learner. For convex losses and a set of
    diameter $D$, the regret is at most $(D^2 / (2 \eta) + \eta) \sqrt{\sum_t |g_t|^2}$.
    The optimiser does not need to know the size or the number of the gradients in
    advance.

    **Returns:** an `optax.GradientTransformation`. Each call returns the same object,
    so learners with this optimiser share compiled code.

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

        ```text
        Array([-0.6, -0.8], dtype=float32)
        ```
    """
    return _ADAGRAD_NORM


class OnlineNewtonState(NamedTuple):
    """The state of `online_newton`.

    - `root`: a root of the inverse of the prior plus the curvature so far.
    - `total`: the sum of the traces of the curvatures that were added.
    - `count`: how many of them were not zero.
    """

    root: Float[Array, "d d"]
    total: Float[Array, ""]
    count: Float[Array, ""]


def _online_newton_init(params: PyTree) -> OnlineNewtonState:
    flat, _ = ravel_pytree(params)
    zero = jnp.zeros((), flat.dtype)
    return OnlineNewtonState(jnp.zeros((flat.size, flat.size), flat.dtype), zero, zero)


class _OnlineNewtonUpdate(eqx.Module):
    """A module, so that it can be saved, and two with the same prior are equal."""

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
                "online_newton: update must be given the curvature of the loss. An "
                "OnlineLearner knows it, but BPC, which sees only the cost, does not."
            )
        gradient, unravel = ravel_pytree(updates)
        factor = curvature()
        root, total, count = state
        size = jnp.sum(factor**2)
        # If this update is larger than the total so far by 1 / sqrt(eps), the total
        # would be lost in rounding, so start again.
        first = size > total / jnp.sqrt(jnp.finfo(size.dtype).eps)
        total, count = jnp.where(first, 0, total), jnp.where(first, 0, count)
        new_total, new_count = total + size, count + (size > 0)
        # In the first `prior` steps, rescale the prior to `prior` average steps so far.
        mean = lambda total, count: total / jnp.where(count > 0, count, 1)  # noqa: E731
        early = (size > 0) & (count > 0) & (count < self.prior)
        # The prior is a multiple of the identity, with the trace of `prior` updates.
        fresh = gradient.size / (self.prior * jnp.where(first, size, 1))
        fresh = jnp.sqrt(fresh) * jnp.eye(gradient.size, dtype=gradient.dtype)
        after = jnp.where(early, mean(new_total, new_count), 1)
        scale = jnp.sqrt(jnp.where(early, mean(total, count) / after, 1))
        root = jnp.where(first, fresh, scale * root)
        # Sherman and Morrison's P - P c c'P / (1 + c'P c) for each column c. Potter's
        # form, on a root of P, stays positive despite rounding.
        for column in factor.T:
            along = column @ root
            gain = 1 + along @ along
            root = root - jnp.outer(root @ along, along) / (gain + jnp.sqrt(gain))
        # P g = root root' g. Divided by the learning rate, because `projected_step`
        # multiplies by it, but Newton's step has a length of its own.
        step = root @ (gradient @ root) / learning_rate
        # A trust region of radius 1 (times the learning rate), because the curvature of
        # the first steps is a guess.
        squared = jnp.sum(step**2)
        long = squared > 1
        step = step * jnp.where(long, 1 / jnp.sqrt(jnp.where(long, squared, 1)), 1)
        return unravel(-step), OnlineNewtonState(root, new_total, new_count)


def online_newton(prior: float = 100.0) -> optax.GradientTransformation:
    r"""Newton's method for online learning, with the sum of the curvatures of all
    losses so far.

    $$\theta_{t+1} = \theta_t - P_t g_t, \qquad
    P_t^{-1} = n c I + \sum_{s \le t} J_s^\top H_s J_s$$

    A step is at most as long as the `learning_rate` of the learner. $J_s$ is the
    derivative of the observation and control of step $s$ with respect to $\theta$.
    $H_s$ is the curvature of the cost at them, or its positive part if the cost is not
    convex. $c$ is the mean curvature per weight over the first $n$ steps that have any.
    So the prior counts as much as $n$ average steps, whatever the scale of the cost,
    the disturbance and the weights.

    With quadratic costs, the optimiser is recursive least squares, and its regret grows
    as $\log T$.

    Only a [`delucax.controllers.OnlineLearner`][] can use this optimiser, because such
    a learner provides the curvature. The memory and the time of a step grow with the
    square of the number of weights.

    **Arguments:** `prior`: $n$, the number of average steps that the prior counts as,
    100 by default. If the features are similar to each other, a small prior makes the
    optimiser learn fast. A large prior makes the learned weights less sensitive to
    noise.

    **Returns:** an `optax.GradientTransformationExtraArgs`. Two optimisers with the
    same prior are equal, so learners with the same prior share compiled code.

    **Raises:** `ValueError` if `prior` is not positive; at the first update, if no
    curvature is given.

    Source: Simchowitz, 2020; Hazan, Agarwal and Kale, 2007; Potter, 1963 (the form).

    !!! example

        ```python
        import delucax as dlx
        import jax

        push = dlx.disturbances.Constant([0.5, 0.5])
        env = dlx.make("lds", key=jax.random.key(0), disturbance=push)
        optimiser = dlx.controllers.online_newton(prior=20.0)
        learner = dlx.controllers.gpc(env.dynamics, env.cost, optimiser=optimiser)
        dlx.rollout(env, learner, key=jax.random.key(0)).total_cost
        ```

        ```text
        Array(9.72, dtype=float32)
        ```
    """
    check_positive(prior, "prior", "online_newton")
    return optax.GradientTransformationExtraArgs(
        _online_newton_init, _OnlineNewtonUpdate(float(prior))
    )


def positive_root(H: Float[Array, "z z"]) -> Float[Array, "z z"]:
    """The Cholesky factor of the positive part of a symmetric matrix.

    A column without a positive pivot is zero.
    """
    # A smaller pivot is rounding, and its square root would be noise.
    slack = len(H) * jnp.finfo(H.dtype).eps * jnp.max(jnp.abs(jnp.diag(H)), initial=0)

    # Column by column in Python, because the matrix is small and a pivot that is not
    # positive must be left out, not give NaN.
    columns = []
    for j in range(len(H)):
        pivot = H[j, j]
        positive = pivot > slack
        column = H[:, j] / jnp.sqrt(jnp.where(positive, pivot, 1))
        columns.append(jnp.where(positive, column, 0))
        H = H - jnp.outer(columns[-1], columns[-1])
    return jnp.stack(columns, axis=1)
