"""Linear tasks: given matrices, random ones, and the cart-pole of the Deluca paper."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr

from .._check import (
    check_count,
    check_instance,
    check_key,
    check_keywords,
    check_number,
    check_positive,
    check_range,
    check_step,
)
from .._jax import host_unless_traced, xp
from .._typing import Matrix, PRNGKey
from ..costs import Quadratic
from ..dynamics import c2d, LinearDynamics
from ..systems import LinearSystem
from ._environment import Environment
from ._task import Fields, UniformState


def cartpole_linear(
    cart_mass: Any = 1.0,
    pole_mass: Any = 0.1,
    length: Any = 1.0,
    gravity: Any = 9.81,
    *,
    dt: Any = 0.02,
    horizon: int = 200,
    **others: Any,
) -> Environment:
    r"""The linear cart-pole of the Deluca paper: a point mass on a rod, linearised
    about upright and discretised by Euler's method.

    $$\ddot p = \frac{F + m g \theta}{M}, \qquad
    \ddot\theta = \frac{F + (M + m) g \theta}{M l}$$

    - *State:* position $p$ [m], angle $\theta$ [rad], velocity [m/s], spin [rad/s], in
        this order. If the angle is positive, the pole leans in the direction of
        negative positions. *Control:* force $F$ [N], without bounds.
    - *Start:* each state is uniformly random in +-0.05.
    - *Cost:* $x^\top x + u^\top u$ per step.
    - *End:* never terminates.

    **Arguments:**

    - `cart_mass`: $M$ [kg], 1 by default.
    - `pole_mass`: $m$ [kg], 0.1 by default.
    - `length`: $l$, length of the rod [m], 1 by default.
    - `gravity`: $g$ [m/s^2], 9.81 by default.
    - `dt`: the time step [s], 0.02 by default.
    - `horizon`: the number of steps per episode, 200 by default, which is 4 s. The code
        of the Deluca paper stops after 10 steps.
    - `**others`: arguments of [`delucax.Environment`][], such as `cost` and
        `disturbance`.

    **Returns:** a [`delucax.Environment`][] whose dynamics are
        [`delucax.LinearDynamics`][].

    **Raises:** `ValueError` if a mass, the length or `dt` is not positive, or `gravity`
        is not finite.

    Source: Gradu et al., 2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.make("cartpole_linear")
        lqr = dlx.controllers.LQR(env.dynamics, jnp.eye(4), jnp.eye(1))
        ```
    """
    where = "cartpole_linear"
    check_keywords(others, where, cartpole_linear, Environment)
    positive = dict(cart_mass=cart_mass, pole_mass=pole_mass, length=length)
    for name, value in positive.items():
        check_positive(value, name, where)
    check_step(dt, where)
    A, B = _euler_step(cart_mass, pole_mass, length, gravity, dt)
    states = ("position", "angle", "velocity", "spin")
    names: Fields = dict(state_names=states, control_names=("force",))
    fields: Fields = dict(
        dynamics=LinearDynamics(A, B, dt=dt, **names),
        cost=Quadratic([1.0] * 4, [1.0]),
        initial_state=UniformState([-0.05] * 4, [0.05] * 4),
        horizon=horizon,
    )
    return Environment(**(fields | others))


@host_unless_traced
def _euler_step(M: Any, m: Any, l: Any, g: Any, dt: Any) -> tuple[Matrix, Matrix]:
    """The matrices of the Euler step of the linear cart-pole."""
    dtype = jnp.result_type(float)
    M, m, l, g = (xp.asarray(number, dtype) for number in (M, m, l, g))
    zero, one = xp.zeros_like(M), xp.ones_like(M)
    rate = [
        [zero, zero, one, zero],
        [zero, zero, zero, one],
        [zero, m * g / M, zero, zero],
        [zero, (m + M) * g / (M * l), zero, zero],
    ]
    B = dt * xp.array([[zero], [zero], [1 / M], [1 / (M * l)]])
    return xp.eye(4) + dt * xp.array(rate), B


def lds(
    A: Any = None,
    B: Any = None,
    C: Any = None,
    *,
    system: LinearDynamics | LinearSystem | None = None,
    dt: Any = None,
    key: PRNGKey | None = None,
    states: int | None = None,
    controls: int | None = None,
    observations: int | None = None,
    spectral_radius: Any = None,
    horizon: int = 200,
    **others: Any,
) -> Environment:
    r"""A linear dynamical system with a quadratic cost.

    $$x_{k+1} = A x_k + B u_k + w_k, \qquad y_k = C x_k, \qquad
    c = x^\top x + u^\top u$$

    Define the system in one of three ways: with matrices, with a linear model `system`,
    or with a random `key`. The first state is zero. The task never terminates.

    **Arguments:**

    - `A`, `B`, `C`: the matrices, shapes `(n, n)`, `(n, m)` and `(p, n)`; `C` is the
        identity by default. Without `A` and `B`, all matrices are drawn with `key`.
        Their entries are standard normal, and then `A` is scaled so that it has the
        given `spectral_radius`.
    - `system`: a [`delucax.LinearDynamics`][] or a [`delucax.systems.LinearSystem`][],
        in place of the matrices. A `LinearSystem` is converted exactly to discrete time
        with the step `dt`. A linear model can be made from a python-control object by
        `delucax.interop.from_control`, from a file by `delucax.interop.read_linear`,
        and from any system by [`delucax.linearize`][].
    - `dt`: the time step, in units of time; 1 by default. `dt` is required for a
        `system` in continuous time, and must be left out for a `system` in discrete
        time.
    - `key`: a random key, for random matrices.
    - `states`, `controls`: the number `n` of states and the number `m` of controls for
        random matrices, 2 and 1 by default.
    - `observations`: the number `p` of observations for a random `C`; by default `C` is
        the identity.
    - `spectral_radius`: the spectral radius of a random `A`, 0.9 by default. The system
        is stable if the spectral radius is below 1.
    - `horizon`: the number of steps per episode, 200 by default.
    - `**others`: arguments of [`delucax.Environment`][], such as `cost` and
        `disturbance`.

    **Returns:** a [`delucax.Environment`][].

    **Raises:** `ValueError` if only one of `A` and `B` is given, if there are neither
    matrices nor a key nor a system, or more than one of these, if sizes of random
    matrices are given with matrices or a system, if shapes do not fit, if `system` is
    not linear, or if `dt` does not fit it.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("lds", key=jax.random.key(0), states=4, spectral_radius=0.95)
        upright = dlx.linearize(dlx.systems.Pendulum())
        sampled = dlx.make("lds", system=upright, dt=0.05)
        ```
    """
    check_keywords(others, "lds", lds, Environment)
    if A is not None or system is not None:
        drawn = dict(states=states, controls=controls, observations=observations)
        for name, value in (drawn | dict(spectral_radius=spectral_radius)).items():
            if value is not None:
                raise ValueError(
                    f"lds: {name} applies only if the matrices are random."
                )
    if system is not None:
        for name, value in {"A": A, "B": B, "C": C, "key": key}.items():
            if value is not None:
                raise ValueError(f"lds: pass {name} or a system, not both.")
        dynamics = _sampled(system, dt)
    else:
        if (A is None) != (B is None):
            missing, other = ("A", "B") if A is None else ("B", "A")
            raise ValueError(
                f"lds: {missing} must be given together with {other}. For random "
                "matrices, leave both out."
            )
        if A is None and C is not None:
            raise ValueError("lds: C needs A and B. For a random C, pass observations.")
        if A is None:
            A, B, C = _random(
                key,
                2 if states is None else states,
                1 if controls is None else controls,
                observations,
                0.9 if spectral_radius is None else spectral_radius,
            )
        elif key is not None:
            raise ValueError("lds: pass A and B, or a key to draw them with, not both.")
        dynamics = LinearDynamics(A, B, C, dt=1.0 if dt is None else dt)
    n, m = dynamics.state_size, dynamics.control_size
    cost = Quadratic([1.0] * n, [1.0] * m)
    fields: Fields = dict(dynamics=dynamics, cost=cost, horizon=horizon)
    return Environment(**(fields | others))


def _sampled(system: Any, dt: Any) -> LinearDynamics:
    """`system` in discrete time."""
    if isinstance(system, LinearDynamics):
        if dt is not None:
            raise ValueError(
                f"lds: dt must be left out for a system in discrete time, got {dt}, "
                f"and the system has {system.dt}."
            )
        return system
    hint = (
        " or LinearDynamics (`delucax.interop.from_control` makes one from a "
        "python-control object, `delucax.interop.read_linear` from a file)"
    )
    check_instance(system, LinearSystem, "system", "lds", hint)
    if dt is None:
        raise ValueError(
            "lds: dt must be given for a system in continuous time, got None."
        )
    return c2d(system, dt)


def _random(
    key: Any, states: int, controls: int, observations: int | None, radius: Any
) -> tuple[Any, Any, Any]:
    """Matrices with standard normal entries, the first scaled to a spectral radius."""
    if key is None:
        raise ValueError(
            "lds: pass A and B, or a key to draw them with, such as "
            "key=jax.random.key(0)."
        )
    check_key(key, "lds")
    n = check_count(states, "states", "lds")
    m = check_count(controls, "controls", "lds")
    check_number(radius, "spectral_radius", "lds")
    check_range(radius, "spectral_radius", "lds")
    shapes = ((n, n), (n, m))
    if observations is not None:
        shapes += ((check_count(observations, "observations", "lds"), n),)
    A, B, *C = _normal(key, shapes)
    return _scaled(A, radius), B, C[0] if C else None


@eqx.filter_jit
def _normal(key: PRNGKey, shapes: tuple[tuple[int, int], ...]) -> list[Matrix]:
    """Standard normal entries, each matrix drawn with a key of its own."""
    keys = jr.split(key, 3)
    return [jr.normal(key, shape) for key, shape in zip(keys, shapes, strict=False)]


@host_unless_traced
def _scaled(A: Matrix, radius: Any) -> Matrix:
    """`A` scaled to a spectral radius."""
    # The eigenvalues scale with the matrix.
    factor = radius / xp.max(xp.abs(xp.linalg.eigvals(A)))
    return A * xp.asarray(factor, A.dtype)
