"""Networks with a hidden state: its dynamics, its outputs, and its encoder."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._check import (
    as_entries,
    as_finite,
    as_matrix,
    check_count,
    check_key,
    check_positive,
)
from ..._check_models import check_matrices
from ..._module import indexed_names, mlp, parameter, positive, shown, weight
from ..._results import Result, RESULTS
from ..._typing import Observation, PRNGKey, RealScalar, State, Time
from ...dynamics import AbstractDynamics
from ...math import matvec


class LatentDynamics(AbstractDynamics):
    r"""Dynamics of a hidden state: a linear part plus fully connected networks.

    $$x_{k+1} = A x_k + B v_k + f(x_k, v_k), \qquad
    y_k = \bar y + \sigma_y\,(C x_k + h(x_k)), \qquad
    v_k = \frac{u_k - \bar u}{\sigma_u}$$

    The state is not measured and has no unit. The last layers of the networks $f$ and
    $h$ are initialised to zero, so the model starts as linear dynamics.
    [`delucax.training.sysid.state_space`][] fits it.

    **Arguments:**

    - `A`, `B`, `C`: the linear part, shapes `(n, n)`, `(n, m)` and `(p, n)`.
    - `width`, `depth`: the number of units in each hidden layer, and the number of
        hidden layers; 16 and 1 by default.
    - `dt`: the step, 1 by default.
    - `u_mean`, `u_size`: $\bar u$ and $\sigma_u$, shape `(m,)` or a number; 0 and 1 by
        default.
    - `y_mean`, `y_size`: $\bar y$ and $\sigma_y$, shape `(p,)` or a number; 0 and 1 by
        default.
    - `key`: a random key for the initial weights.

    **Attributes:** `transition` and `output`, the networks $f$ and $h$, each an
    `eqx.nn.MLP`. The networks are trainable, like `A`, `B` and `C`.

    **Raises:** `ValueError` if a shape is wrong, or a size is not positive.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        A, B, C = [[0.9, 0.3], [-0.3, 0.9]], [[0.0], [1.0]], [[1.0, 0.0]]
        key = jax.random.key(0)
        dynamics = dlx.training.sysid.LatentDynamics(A, B, C, width=8, key=key)
        dynamics.observe(0.0, dynamics(0.0, jnp.ones(2), jnp.zeros(1)))
        ```

        ```text
        Array([1.2], dtype=float32)
        ```
    """

    A: Float[Array, "n n"] = weight()
    B: Float[Array, "n m"] = weight()
    C: Float[Array, "p n"] = weight()
    transition: eqx.nn.MLP = weight()
    output: eqx.nn.MLP = weight()
    dt: Array = parameter()
    u_mean: Float[Array, "..."] = parameter()
    u_size: Float[Array, "..."] = parameter(constraint=positive)
    y_mean: Float[Array, "..."] = parameter()
    y_size: Float[Array, "..."] = parameter(constraint=positive)
    state_names: tuple[str, ...] = eqx.field(static=True)
    control_names: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        A: Any,
        B: Any,
        C: Any,
        width: int = 16,
        depth: int = 1,
        *,
        dt: Any = 1.0,
        u_mean: Any = 0.0,
        u_size: Any = 1.0,
        y_mean: Any = 0.0,
        y_size: Any = 1.0,
        key: PRNGKey,
    ):
        where = "LatentDynamics"
        C = as_matrix(C, "C", where)
        self.A, self.B, self.C, _ = check_matrices(A, B, C, None, where)
        (p, n), m = C.shape, self.B.shape[1]
        self.state_names = indexed_names("x", n)
        self.control_names = indexed_names("u", m)
        size = _checked_sizes(width, depth, where)
        of_steps, of_outputs = jax.random.split(check_key(key, where))
        self.transition = _quiet(n + m, n, *size, of_steps)
        self.output = _quiet(n, p, *size, of_outputs)
        self.dt, self.u_mean, self.u_size = dt, u_mean, u_size
        self.y_mean, self.y_size = y_mean, y_size

    def __check_init__(self):
        m, p = self.control_size, self.C.shape[0]
        sizes = dict(u_mean=m, u_size=m, y_mean=p, y_size=p)
        _check_scales(self, sizes, "LatentDynamics")

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        v = (u - self.u_mean) / self.u_size
        x_next = matvec(self.A, x) + matvec(self.B, v)
        x_next = x_next + self.transition(jnp.concatenate([x, v]))
        x_next = x_next if w is None else x_next + w
        return x_next.astype(x.dtype), RESULTS.successful

    def observe(self, t: Time, x: State) -> Observation:
        return self.y_mean + self.y_size * (matvec(self.C, x) + self.output(x))


class Encoder(eqx.Module):
    r"""Computes the hidden state of a model from the last outputs and controls.

    $$x_k = E z + e(z)$$

    Here $z$ holds the outputs and controls of the samples `k - past` to `k - 1`,
    normalised as $(y - \bar y) / \sigma_y$ and $(u - \bar u) / \sigma_u$. The last
    layer of the fully connected network $e$ is initialised to zero.

    A call `encoder(outputs, controls)` takes these outputs, shape `(past, p)`, and
    controls, shape `(past, m)`, and returns the state $x_k$, shape `(n,)`.

    **Arguments:**

    - `matrix`: $E$, shape `(n, past (p + m))`. The first columns belong to all past
        outputs, earliest first, and the other columns to all past controls.
    - `past`: the number of samples.
    - `outputs`: the number of outputs, p.
    - `width`, `depth`: the number of units in each hidden layer, and the number of
        hidden layers; 16 and 1 by default.
    - `u_mean`, `u_size`: $\bar u$ and $\sigma_u$, shape `(m,)` or a number; 0 and 1 by
        default.
    - `y_mean`, `y_size`: $\bar y$ and $\sigma_y$, shape `(p,)` or a number; 0 and 1 by
        default.
    - `key`: a random key for the initial weights.

    **Attributes:** `matrix`, and `network`, the `eqx.nn.MLP` $e$. Both are trainable.

    **Raises:** `ValueError` if a shape is wrong, at construction or in a call, or a
        size is not positive.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        Encoder = dlx.training.sysid.Encoder
        encoder = Encoder(jnp.ones((2, 10)), 5, 1, key=jax.random.key(0))
        encoder(jnp.ones((5, 1)), jnp.zeros((5, 1)))
        ```

        ```text
        Array([5., 5.], dtype=float32)
        ```
    """

    matrix: Float[Array, "n z"] = weight()
    network: eqx.nn.MLP = weight()
    u_mean: Float[Array, "..."] = parameter()
    u_size: Float[Array, "..."] = parameter(constraint=positive)
    y_mean: Float[Array, "..."] = parameter()
    y_size: Float[Array, "..."] = parameter(constraint=positive)
    past: int = eqx.field(static=True)
    outputs: int = eqx.field(static=True)

    __repr__ = shown

    def __init__(
        self,
        matrix: Any,
        past: int,
        outputs: int,
        width: int = 16,
        depth: int = 1,
        *,
        u_mean: Any = 0.0,
        u_size: Any = 1.0,
        y_mean: Any = 0.0,
        y_size: Any = 1.0,
        key: PRNGKey,
    ):
        where = "Encoder"
        self.past = check_count(past, "past", where)
        self.outputs = check_count(outputs, "outputs", where)
        of_outputs = self.past * self.outputs
        fits = lambda s: len(s) == 2 and not s[1] % self.past and s[1] > of_outputs
        rule = f"have {past} columns for each of {outputs} outputs and for each control"
        self.matrix = as_finite(matrix, "matrix", where, rule, fits)
        n, size = self.matrix.shape
        width, depth = _checked_sizes(width, depth, where)
        self.network = _quiet(size, n, width, depth, check_key(key, where))
        self.u_mean, self.u_size = u_mean, u_size
        self.y_mean, self.y_size = y_mean, y_size

    @property
    def controls(self) -> int:
        """The number of controls."""
        return self.matrix.shape[1] // self.past - self.outputs

    def __check_init__(self):
        m, p = self.controls, self.outputs
        sizes = dict(u_mean=m, u_size=m, y_mean=p, y_size=p)
        _check_scales(self, sizes, "Encoder")

    def __call__(
        self, outputs: Float[Array, "past p"], controls: Float[Array, "past m"]
    ) -> Float[Array, " n"]:
        outputs = _checked(outputs, "outputs", (self.past, self.outputs))
        controls = _checked(controls, "controls", (self.past, self.controls))
        y = (outputs - self.y_mean) / self.y_size
        v = (controls - self.u_mean) / self.u_size
        z = jnp.concatenate([y.ravel(), v.ravel()])
        return self.matrix @ z + self.network(z)


def _checked(value: Any, name: str, shape: tuple[int, int]) -> Array:
    fits = lambda given: given == shape
    return as_finite(value, name, "Encoder", f"have shape {shape}", fits)


def _check_scales(module: Any, sizes: dict[str, int], where: str) -> None:
    for name, size in sizes.items():
        array = getattr(module, name)
        as_entries(array, size, name, where)
        if name.endswith("_size"):
            check_positive(array, name, where)


def _checked_sizes(width: Any, depth: Any, where: str) -> tuple[int, int]:
    width = check_count(width, "width", where)
    return width, check_count(depth, "depth", where, least=0)


def _quiet(inputs: int, outputs: int, width: int, depth: int, key: PRNGKey) -> Any:
    """A fully connected network whose last layer is zero."""
    network = mlp(inputs, outputs, width, depth, key=key)
    last = lambda network: (network.layers[-1].weight, network.layers[-1].bias)
    return eqx.tree_at(last, network, replace_fn=jnp.zeros_like)
