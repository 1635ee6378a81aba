"""Linear dynamical systems."""

from typing import Any

import jax.numpy as jnp
import jax.random as jr
import numpy as np

from .._check import check_count, check_key, is_concrete
from .._typing import PRNGKey
from ..costs import Quadratic
from ..dynamics import LinearDynamics
from ._environment import Environment
from ._registry import finish


def lds(
    A: Any = None,
    B: Any = None,
    C: Any = None,
    *,
    key: PRNGKey | None = None,
    states: int = 2,
    controls: int = 1,
    observations: int | None = None,
    spectral_radius: Any = 0.9,
    horizon: int = 200,
    **environment: Any,
) -> Environment:
    """A linear dynamical system `x_next = A x + B u + w`, `y = C x`, at quadratic cost
    `x'x + u'u`.

    **Arguments:**

    - `A`, `B`, `C`: the matrices; `C` is the identity by default. If neither `A` nor
        `B` is given, all are drawn with `key`: entries standard normal, `A` scaled to
        the spectral radius.
    - `key`: a random key, for random matrices.
    - `states`, `controls`: sizes of random matrices, 2 and 1 by default.
    - `observations`: rows of a random `C`; the identity by default.
    - `spectral_radius`: of the random `A`, 0.9 by default; below 1 is stable.
    - `horizon`: steps an episode, 200 by default.
    - `**environment`: other arguments of [`delucax.Environment`][], such as `cost` and
        `disturbance`.

    **Returns:** an [`delucax.Environment`][], with `dt = 1`.

    **Raises:** `ValueError` if one of `A` and `B` is missing, if there is no key to
    draw them with, or if shapes do not fit.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("lds", key=jax.random.key(0), states=4, spectral_radius=0.95)
        ```
    """
    if (A is None) != (B is None):
        missing = "A" if A is None else "B"
        raise ValueError(f"lds: {missing} must be given with the other, or neither.")
    if A is None:
        if C is not None:
            raise ValueError("lds: C needs A and B; for a random C give observations.")
        if key is None:
            raise ValueError(
                "lds: give A and B, or a key to draw them with, such as "
                "key=jax.random.key(0)."
            )
        check_key(key, "lds")
        n = check_count(states, "states", "lds")
        m = check_count(controls, "controls", "lds")
        known = is_concrete(spectral_radius)
        if known and not 0 <= spectral_radius < np.inf:
            raise ValueError(
                "lds: spectral_radius must be finite and not negative, got "
                f"{spectral_radius}."
            )
        a, b, c = jr.split(key, 3)
        A = jr.normal(a, (n, n))
        A = A * (spectral_radius / jnp.max(jnp.abs(jnp.linalg.eigvals(A))))
        B = jr.normal(b, (n, m))
        if observations is not None:
            p = check_count(observations, "observations", "lds")
            C = jr.normal(c, (p, n))
    dynamics = LinearDynamics(A, B, C)
    n, m = dynamics.state_size, dynamics.control_size
    arguments: dict[str, Any] = dict(
        dynamics=dynamics,
        cost=Quadratic(jnp.eye(n), jnp.eye(m)),
        horizon=horizon,
    )
    return finish(lds, arguments, environment)
