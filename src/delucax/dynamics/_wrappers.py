"""Dynamics with an adversary that acts on the state."""

from dataclasses import KW_ONLY
from typing import Any

from jaxtyping import Array, Float

from .._check import as_matrix, check_instance, check_positive
from .._module import parameter
from .._results import Result
from .._typing import Real, RealScalar
from ..math import matvec
from ..math._norms import within_ball
from ._base import AbstractDynamics, AbstractWrapper


class WorstCase(AbstractWrapper):
    r"""Dynamics with an adversary, which adds a state feedback to the disturbance.

    $$x_{k+1} = F(t_k, x_k, u_k, w_k + L (x_k - x_\mathrm{ref}))$$

    Here $x_\mathrm{ref}$ is the equilibrium of the dynamics. The deviation
    $x_k - x_\mathrm{ref}$ is computed by the method `difference` of the dynamics. If
    `L` is the gain of [`delucax.controllers.HInfinity`][] or of
    [`delucax.riccati.hinf_dare`][], the adversary plays the worst disturbance of the
    H-infinity game. Use `bound` to keep it realistic.

    **Arguments:**

    - `dynamics`: the plant, a [`delucax.AbstractDynamics`][] with an `equilibrium`.
    - `L`: the gain of the adversary, shape `(k, n)`.
    - `bound`: the largest Euclidean norm of the adversary's disturbance; a larger
        disturbance is scaled back to this norm. None by default.

    **Raises:** `ValueError` if `dynamics` is not an `AbstractDynamics` or has no
    equilibrium, `L` does not fit it, or `bound` is not positive.

    Source: Basar and Bernhard, 1995.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B = jnp.array([[1.0, 1.0], [0.0, 1.0]]), jnp.array([[0.0], [1.0]])
        dynamics = dlx.LinearDynamics(A, B)
        robust = dlx.controllers.HInfinity(dynamics, jnp.eye(2), jnp.eye(1))
        attacked = dlx.dynamics.WorstCase(dynamics, 0.9 * robust.L, bound=1.0)
        env = dlx.Environment(attacked, dlx.costs.Quadratic(jnp.eye(2), jnp.eye(1)))
        x0 = jnp.ones(2)
        dlx.rollout(env, robust, key=jax.random.key(0), x0=x0, horizon=50).total_cost
        ```

        ```text
        Array(22.54, dtype=float32)
        ```
    """

    dynamics: AbstractDynamics
    L: Float[Array, "k n"] = parameter()
    _: KW_ONLY
    bound: Real | None = parameter(None)

    def __check_init__(self):
        where, dynamics = "WorstCase", self.dynamics
        check_instance(dynamics, AbstractDynamics, "dynamics", where)
        dynamics.equilibrium()  # raises where there is none
        as_matrix(self.L, "L", where)
        shape = dynamics.disturbance_size, dynamics.state_size
        if self.L.shape != shape:
            raise ValueError(
                f"{where}: L must have shape {shape}, a row for each disturbance and a "
                f"column for each state, got shape {self.L.shape}."
            )
        if self.bound is not None:
            check_positive(self.bound, "bound", where)

    def attack(self, x: Array) -> Array:
        """The adversary's part of the disturbance.

        **Arguments:** `x`: the state, shape `(n,)`.

        **Returns:** the disturbance, shape `(k,)`.
        """
        x_ref, _ = self.dynamics.equilibrium()
        added = matvec(self.L, self.dynamics.difference(x, x_ref)).astype(x.dtype)
        if self.bound is None:
            return added
        return within_ball(added, self.bound)

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        return self.dynamics.advance(t, x, u, self._attacked(x, w))

    def advance_with_events(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result, Any]:
        return self.dynamics.advance_with_events(t, x, u, self._attacked(x, w))

    def _attacked(self, x, w):
        # The adversary adds to the environment's own disturbance.
        added = self.attack(x)
        return added if w is None else w + added
