"""A controller with a learned correction."""

import jax.random as jr
from jaxtyping import Array, PyTree

from .._check import as_bounds, bounds_field
from .._controller import AbstractController, check_controller
from .._typing import PRNGKey, RealScalar
from ..math import clip


class Residual(AbstractController):
    r"""A controller plus a learned correction, for example an LQR plus a network.

    $$u = \operatorname{clip}(\pi_\mathrm{base}(t, y), \mathrm{low}, \mathrm{high}) +
    \pi_\mathrm{correction}(t, y)$$

    After each step, both controllers get the total control that was applied.
    [`delucax.training.fit`][] with `trainable="correction"` trains only the correction.

    **Arguments:**

    - `base`: the controller without the correction.
    - `correction`: the controller whose control is added.
    - `bounds`: `(low, high)`, each a number or of shape `(m,)`, to which the control of
        `base` is clipped before the correction is added; none by default. Without
        `bounds`, the control of `base` may be far beyond the environment's bounds, and
        then a small correction has no effect.

    **Raises:** `ValueError` if `base` or `correction` is not a controller, or a lower
    bound is above its upper bound; at run time, if the two controls differ in size.

    Source: Johannink et al., 2019; Silver, Allen, Tenenbaum and Kaelbling, 2018
    (residual policy learning).

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("cartpole_linear")
        lqr = dlx.controllers.local_lqr(env)
        network = dlx.controllers.mlp_policy(env, 8, 1, key=jax.random.key(0))
        policy = dlx.controllers.Residual(lqr, network)
        dlx.rollout(env, policy, key=jax.random.key(1), horizon=10).total_cost
        ```
    """

    base: AbstractController
    correction: AbstractController
    bounds: tuple[Array, Array] | None = bounds_field("Residual", default=None)

    def __check_init__(self):
        check_controller(self.base, "base", "Residual")
        check_controller(self.correction, "correction", "Residual")
        as_bounds(self.bounds, "Residual")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        first, second = (None, None) if key is None else jr.split(key)
        return self.base.init(key=first), self.correction.init(key=second)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        base_state, correction_state = state
        u, base_state = self.base(t, y, base_state)
        if self.bounds is not None:
            u = clip(u, *self.bounds)
        change, correction_state = self.correction(t, y, correction_state)
        if change.shape != u.shape:
            raise ValueError(
                "Residual: base and correction must give controls of one size, got "
                f"shapes {u.shape} and {change.shape}."
            )
        return (u + change).astype(y.dtype), (base_state, correction_state)

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        base, correction = self.base, self.correction
        return base.applied(u, cost, state[0]), correction.applied(u, cost, state[1])
