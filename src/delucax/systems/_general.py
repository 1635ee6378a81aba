"""General systems: from matrices, from a function, from a neural network."""

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._check import as_vector, check_function
from .._check_models import check_matrices, checked_names, state_network
from .._module import (
    as_float_array,
    function_field,
    indexed_names,
    names_of,
    parameter,
    weight,
)
from .._typing import (
    Control,
    Disturbance,
    Matrix,
    Observation,
    PRNGKey,
    State,
    Time,
    Vector,
)
from ..math import matvec
from ._base import AbstractSystem


class LinearSystem(AbstractSystem):
    r"""A linear system, or an affine system about an operating point.

    $$\dot x = \dot x_\mathrm{ref} + A (x - x_\mathrm{ref}) + B (u - u_\mathrm{ref})
    + E w, \qquad y = C x$$

    **Arguments:**

    - `A`: shape `(n, n)`.
    - `B`: shape `(n, m)`.
    - `C`: shape `(p, n)`; the identity by default.
    - `E`: the matrix by which the disturbance `w` enters the vector field, shape
        `(n, k)`. If you do not give `E`, `w` has the size of the state, and the
        discrete-time dynamics add `w` to the next state.
    - `x_ref`, `u_ref`: the operating point, shapes `(n,)` and `(m,)`; zero by default.
    - `dx_ref`: $\dot x_\mathrm{ref}$, the vector field at the operating point, shape
        `(n,)`; zero by default.
    - `state_names`, `control_names`: tuples of `n` and `m` strings; `("x0", ...)` and
        `("u0", ...)` by default.

    **Raises:** `ValueError` if shapes do not fit or entries are not finite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        A = jnp.array([[0.0, 1.0], [0.0, 0.0]])
        B = jnp.array([[0.0], [1.0]])
        system = dlx.systems.LinearSystem(A, B)
        system.vector_field(0.0, jnp.array([1.0, 0.5]), jnp.ones(1), None)
        ```

        ```text
        Array([0.5, 1. ], dtype=float32)
        ```
    """

    A: Matrix = parameter()
    B: Matrix = parameter()
    C: Matrix | None = parameter(None)
    E: Matrix | None = parameter(None)
    _: KW_ONLY
    x_ref: Vector = parameter(None)
    u_ref: Vector = parameter(None)
    dx_ref: Vector = parameter(None)
    state_names: tuple[str, ...] = eqx.field(static=True, default=None)
    control_names: tuple[str, ...] = eqx.field(static=True, default=None)

    def __post_init__(self):
        where = "LinearSystem"
        self.A, self.B, self.C, self.E = check_matrices(
            self.A, self.B, self.C, self.E, where
        )
        n, m = self.B.shape
        for name, size in (("x_ref", n), ("u_ref", m), ("dx_ref", n)):
            if getattr(self, name) is None:
                zero = as_float_array(np.zeros(size, self.A.dtype))
                setattr(self, name, zero)
        self.state_names = checked_names(self.state_names, "x", n, "state_names", where)
        self.control_names = checked_names(
            self.control_names, "u", m, "control_names", where
        )

    def __check_init__(self):
        where = "LinearSystem"
        n, m = check_matrices(self.A, self.B, self.C, self.E, where)[1].shape
        as_vector(self.x_ref, n, "x_ref", where)
        as_vector(self.u_ref, m, "u_ref", where)
        as_vector(self.dx_ref, n, "dx_ref", where)
        checked_names(self.state_names, "x", n, "state_names", where)
        checked_names(self.control_names, "u", m, "control_names", where)

    @property
    def disturbance_names(self) -> tuple[str, ...]:
        """Names of the disturbances, one for each column of `E`."""
        return () if self.E is None else indexed_names("w", self.E.shape[1])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        # Deviations are taken before the products: far from zero, `A x - A x_ref`
        # would lose digits. dx_ref is not zero if the point is no equilibrium.
        dx = self.dx_ref + matvec(self.A, x - self.x_ref)
        dx = dx + matvec(self.B, u - self.u_ref)
        if self.E is not None and w is not None:
            dx = dx + matvec(self.E, w)
        return dx

    def observe(self, t: Time, x: State) -> Observation:
        return x if self.C is None else matvec(self.C, x)

    def equilibrium(self) -> tuple[State, Control]:
        return self.x_ref, self.u_ref


def _as_tuple(names: Any) -> Any:
    # Only lists, so that a string is refused later.
    return tuple(names) if isinstance(names, list) else names


class FunctionSystem(AbstractSystem):
    """A system whose vector field is a function. [`delucax.system`][] makes one.

    **Arguments:**

    - `function`: `(t, x, u, w) -> dx/dt`. The function may be an `eqx.Module`: its
        arrays are then leaves of the system.
    - `state_names`, `control_names`: tuples of strings.
    - `disturbance_names`: a tuple of strings, empty by default.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        decay = dlx.system(lambda t, x, u, w: u - x, states=1, controls=1)
        decay.vector_field(0.0, jnp.array([2.0]), jnp.array([0.5]), None)
        ```

        ```text
        Array([-1.5], dtype=float32)
        ```
    """

    function: Callable[..., Array] = function_field(of="t, x, u, w")
    state_names: tuple[str, ...] = eqx.field(static=True, converter=_as_tuple)
    control_names: tuple[str, ...] = eqx.field(static=True, converter=_as_tuple)
    _: KW_ONLY
    disturbance_names: tuple[str, ...] = eqx.field(
        static=True, converter=_as_tuple, default=()
    )

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> Any:
        return self.function(t, x, u, w)


def system(
    f: Callable[..., Array],
    *,
    states: int | Sequence[str],
    controls: int | Sequence[str],
    disturbances: int | Sequence[str] = (),
) -> FunctionSystem:
    """A system from a function `f(t, x, u, w) -> dx/dt`.

    **Arguments:**

    - `f`: the vector field. Constants inside a function are fixed. To train constants
        or to differentiate with respect to them, pass an `eqx.Module` with a `__call__`
        and make the constants its fields.
    - `states`, `controls`: the names of the states and controls, or how many there are.
    - `disturbances`: the names of the disturbances that enter `f`, or how many there
        are. By default there are no names, and the disturbance `w` is added to the next
        state.

    **Returns:** a [`delucax.systems.FunctionSystem`][].

    **Raises:** `ValueError` if `states`, `controls` or `disturbances` is neither a
    number nor strings.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        def double_integrator(t, x, u, w):
            return jnp.stack([x[1], u[0]])

        car = dlx.system(double_integrator, states=("position", "speed"), controls=1)
        car.vector_field(0.0, jnp.array([1.0, 0.5]), jnp.array([2.0]), None)
        ```

        ```text
        Array([0.5, 2. ], dtype=float32)
        ```
    """
    check_function(f, "f", "system", "t, x, u, w")
    return FunctionSystem(
        f,
        names_of(states, "x", "states", "system"),
        names_of(controls, "u", "controls", "system"),
        disturbance_names=names_of(disturbances, "w", "disturbances", "system"),
    )


class NeuralSystem(AbstractSystem):
    r"""A system whose vector field is a neural network of the state and the control.

    $$\dot x = \mathrm{network}(x, u)$$

    The network is fully connected. It can be differentiated as often as its activation.
    The network is trainable: [`delucax.training.fit`][] changes the network and nothing
    else.

    **Arguments:**

    - `states`, `controls`: the names of the states and controls, or how many there are.
    - `width`: units in each hidden layer, 64 by default.
    - `depth`: number of hidden layers, 2 by default; 0 for a linear vector field.
    - `activation`: activation of the hidden layers, `jnp.tanh` by default.
    - `key`: a random key for the initial weights.

    **Attributes:** `network`, an `eqx.nn.MLP`, trainable; `state_names` and
    `control_names`.

    **Raises:** `ValueError` if a size is below 1, names are neither a number nor
    strings, or there is no key.

    Source: Chen, Rubanova, Bettencourt and Duvenaud, 2018.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        field = dlx.systems.NeuralSystem(2, 1, width=32, key=jax.random.key(0))
        dynamics = dlx.Discretized(field, dt=0.05)
        dynamics(0.0, jnp.ones(2), jnp.zeros(1)).shape
        ```

        ```text
        (2,)
        ```
    """

    network: eqx.nn.MLP = weight()
    state_names: tuple[str, ...] = eqx.field(static=True)
    control_names: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        states: int | Sequence[str],
        controls: int | Sequence[str],
        width: int = 64,
        depth: int = 2,
        *,
        activation: Callable[[Array], Array] = jnp.tanh,
        key: PRNGKey,
    ):
        self.state_names, self.control_names, self.network = state_network(
            states, controls, width, depth, activation, key, "NeuralSystem"
        )

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        return self.network(jnp.concatenate([x, u])).astype(x.dtype)
