"""Balance a pole on a cart: Gym's CartPole-v1, and the paper's linear one."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import check_bool, check_keywords, check_positive, check_range, check_step
from .._jax import fence
from .._module import as_float_array, parameter, positive
from .._typing import BoolScalar, Control, State, Time
from ..costs import Arrival, Quadratic
from ..dynamics import Discretized, LinearDynamics
from ..systems import CartPole
from ._environment import Environment
from ._gym import AbstractGymStep
from ._task import task
from ._uniform_state import UniformState


class GymCartPole(AbstractGymStep):
    """Gym's arithmetic for the cart-pole: an explicit Euler step; then `w` is added.

    Smooth. The angle is not wrapped.

    **Arguments:**

    - `system`: the cart-pole.
    - `dt`: the step, 0.02 by default.
    - `semi_implicit`: whether the positions move with the new velocities, Gym's other
        integrator. False by default.

    **Raises:** `ValueError` if `dt` is not positive, or `semi_implicit` is not a bool.

    Source: Gymnasium (Towers et al., 2023), `CartPole-v1`.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        dynamics = dlx.environments.GymCartPole(dlx.systems.CartPole())
        dynamics(0.0, jnp.array([0.0, 0.0, 0.1, 0.0]), jnp.ones(1))
        ```
    """

    system: CartPole
    dt: Array = parameter(0.02, constraint=positive)
    semi_implicit: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_bool(self.semi_implicit, "semi_implicit", "GymCartPole")

    def gym_step(self, x: State, u: Control) -> State:
        dt = self.dt
        position, velocity, angle, spin = x[0], x[1], x[2], x[3]
        acceleration, turn = fence(*self.system.accelerations(angle, spin, u[0]))
        velocity_next, spin_next = velocity + dt * acceleration, spin + dt * turn
        if self.semi_implicit:
            velocity, spin = velocity_next, spin_next
        position, angle = position + dt * velocity, angle + dt * spin
        return jnp.stack([position, velocity_next, angle, spin_next])


class _Fallen(eqx.Module):
    """Whether the cart has left the track or the pole has fallen."""

    max_position: Array = parameter()
    max_angle: Array = parameter()

    def __call__(self, t: Time, x: State) -> BoolScalar:
        return (abs(x[0]) > self.max_position) | (abs(x[2]) > self.max_angle)


@task(CartPole, gym=GymCartPole, dt=0.02, horizon=500)
def cartpole(
    dynamics: GymCartPole | Discretized,
    *,
    max_force: Any = 10.0,
    max_position: Any = 2.4,
    max_angle: Any = 12 * 2 * np.pi / 360,
) -> dict[str, Any]:
    """Keep a pole upright on a cart that a force pushes to and fro.

    State (position, velocity, angle, spin), upright at 0; control (force), continuous
    within its bounds; the integer actions 0 and 1 are Gym's forces -10 and 10. Starts
    with each state uniform in +-0.05. A step costs -1; the episode ends when the
    position or the angle leaves its bounds.

    The dynamics are smooth as they are. That cost has no gradient: for planning and
    policy gradients give a [`delucax.costs.Quadratic`][] as `cost`. The linear model
    about the upright pole is `dlx.linearize(env.dynamics)`.

    **Arguments:**

    - `system`: a [`delucax.systems.CartPole`][]; made of `others` by default.
    - `dt`: the control interval, 0.02 by default.
    - `horizon`: steps an episode, 500 by default.
    - `max_force`: 10 by default.
    - `max_position`: where the track ends, 2.4 by default.
    - `max_angle`: beyond which the pole has fallen, 12 degrees by default.
    - `solver`: a Diffrax solver in place of Gym's arithmetic.
    - `substeps`: solver steps an interval, with `solver`.
    - `**others`: arguments of [`delucax.systems.CartPole`][], of
        [`delucax.environments.GymCartPole`][], such as `semi_implicit`, without a
        `solver`, or of [`delucax.Environment`][], such as `disturbance`.

    **Returns:** an [`delucax.Environment`][].

    **Raises:** `ValueError` on illegal numbers, `substeps` without `solver`, or
        `semi_implicit` with it.

    Source: Gymnasium (Towers et al., 2023), `CartPole-v1`; Barto, Sutton and Anderson,
    1983.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.environments.cartpole(half_length=0.6)
        env.step(0.0, jnp.zeros(4), 1)
        smooth = dlx.make("cartpole", cost=dlx.costs.Quadratic(jnp.eye(4), jnp.eye(1)))
        lqr = dlx.controllers.LQR(dlx.linearize(env.dynamics), jnp.eye(4), jnp.eye(1))
        ```
    """
    check_range(max_force, "max_force", "cartpole")
    check_positive(max_position, "max_position", "cartpole")
    check_positive(max_angle, "max_angle", "cartpole")
    # Gym's own: twice where the episode ends, which no state of an episode reaches.
    feature_bound = jnp.array([2 * max_position, np.inf, 2 * max_angle, np.inf])
    return dict(
        cost=Arrival(step_cost=-1.0),
        initial_state=UniformState([-0.05] * 4, [0.05] * 4),
        control_bounds=(-max_force, max_force),
        terminated=_Fallen(max_position, max_angle),
        actions=max_force * jnp.array([[-1.0], [1.0]]),
        observation_bounds=(-feature_bound, feature_bound),
    )


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
    """The linear cart-pole of the Deluca paper: a point mass on a rod near the upright,
    by an Euler step, at quadratic cost `x'x + u'u`.

    ```
    d(velocity)/dt = (force + m g angle) / M
    d(spin)/dt = (force + (M + m) g angle) / (M l)
    ```

    State (position, angle, velocity, spin), in this order; control (force), without
    bounds. The angle grows against the direction of positive positions. Starts with
    each state uniform in +-0.05. Never terminates.

    **Arguments:**

    - `cart_mass`: M [kg], 1 by default.
    - `pole_mass`: m [kg], 0.1 by default.
    - `length`: l, of the rod [m], 1 by default.
    - `gravity`: g [m/s^2], 9.81 by default.
    - `dt`: the step, 0.02 by default.
    - `horizon`: steps an episode, 200 by default: 4 s, where the paper's code stops
        after 10 steps.
    - `**others`: arguments of [`delucax.Environment`][], such as `cost` and
        `disturbance`.

    **Returns:** an [`delucax.Environment`][] whose dynamics are
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
    check_positive(cart_mass, "cart_mass", where)
    check_positive(pole_mass, "pole_mass", where)
    check_positive(length, "length", where)
    check_step(dt, where)
    M, m, l, g = (as_float_array(v) for v in (cart_mass, pole_mass, length, gravity))
    zero, one = jnp.zeros_like(M), jnp.ones_like(M)
    rate = [
        [zero, zero, one, zero],
        [zero, zero, zero, one],
        [zero, m * g / M, zero, zero],
        [zero, (m + M) * g / (M * l), zero, zero],
    ]
    A = jnp.eye(4) + dt * jnp.array(rate)
    B = dt * jnp.array([[zero], [zero], [1 / M], [1 / (M * l)]])
    dynamics = LinearDynamics(
        A,
        B,
        dt=dt,
        state_names=("position", "angle", "velocity", "spin"),
        control_names=("force",),
    )
    fields: dict[str, Any] = dict(
        dynamics=dynamics,
        cost=Quadratic(jnp.ones(4), jnp.ones(1)),
        initial_state=UniformState([-0.05] * 4, [0.05] * 4),
        horizon=horizon,
    )
    return Environment(**(fields | others))
