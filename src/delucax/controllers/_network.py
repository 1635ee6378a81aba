"""Neural network policies, and the scaling of their inputs."""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._check import (
    as_bounds,
    bounds_field,
    check_choice,
    check_count,
    check_function,
    check_instance,
    check_key,
    check_positive,
    check_vector,
    is_concrete,
)
from .._controller import AbstractController, wrong_observation
from .._module import as_float_array, function_field, mlp, parameter, shown, weight
from .._typing import PRNGKey, Real, RealScalar
from ..environments import Environment
from ._stochastic import Gaussian


class MLP(AbstractController):
    r"""A fully connected network (multilayer perceptron) of the observation.

    $$u = f(\phi(y)), \qquad \text{with bounds} \quad
    u = \tfrac12 (\mathrm{high} + \mathrm{low}) +
    \tfrac12 (\mathrm{high} - \mathrm{low}) \tanh f(\phi(y))$$

    **Arguments:**

    - `in_size`: the size of the features $\phi(y)$.
    - `out_size`: the number of controls.
    - `width`: the number of units in a hidden layer, 64 by default.
    - `depth`: the number of hidden layers, 2 by default; 0 for a linear map.
    - `features`: $\phi$, a function of an observation, such as `env.encode`; the
        observation itself by default.
    - `bounds`: the bounds `(low, high)` of the control, each a finite number or vector;
        none by default. The function `tanh` keeps the control between these bounds.
    - `activation`: the activation function of the hidden layers, `jnp.tanh` by default.
    - `key`: a random key for the initial weights.

    **Attributes:** `network`, the network $f$, an `eqx.nn.MLP`, trainable.

    **Raises:** `ValueError` if a size is below 1, bounds are not finite or there is no
    key; at run time, if the size of the features is not `in_size`.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        policy = dlx.controllers.MLP(
            env.feature_size,
            env.control_size,
            width=32,
            depth=1,
            features=env.encode,
            bounds=env.control_bounds,
            key=jax.random.key(0),
        )
        dlx.rollout(env, policy, key=jax.random.key(1), x0=[0.1, 0.0]).total_cost
        ```

        ```text
        Array(1077., dtype=float32)
        ```
    """

    network: eqx.nn.MLP = weight()
    features: Callable[[Array], Array] | None = function_field(of="y")
    bounds: tuple[Array, Array] | None = bounds_field("MLP")

    def __init__(
        self,
        in_size: int,
        out_size: int,
        width: int = 64,
        depth: int = 2,
        *,
        features: Callable[[Array], Array] | None = None,
        bounds: Any = None,
        activation: Callable[[Array], Array] = jnp.tanh,
        key: PRNGKey,
    ):
        where = "MLP"
        check_function(activation, "activation", where, "x")
        check_key(key, where)
        self.network = mlp(
            check_count(in_size, "in_size", where),
            check_count(out_size, "out_size", where),
            check_count(width, "width", where),
            check_count(depth, "depth", where, least=0),
            activation,
            key=key,
        )
        self.features = features
        self.bounds = bounds

    def __check_init__(self):
        check_squash(self.bounds, int(self.network.out_size), "MLP")

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        z = features_of(self, y, int(self.network.in_size))
        return squash(self.network(z), self.bounds).astype(y.dtype), state


def features_of(controller: Any, y: Array, size: int) -> Float[Array, " size"]:
    """The features of an observation, or an error unless there are `size` of them."""
    features = controller.features
    z = y if features is None else jnp.asarray(features(y))
    if z.shape != (size,):
        raise wrong_observation(controller, size, z)
    return z


def squash(u: Array, bounds: tuple[Array, Array] | None) -> Array:
    """`u` squashed between the bounds by `tanh`."""
    if bounds is None:
        return u
    low, high = bounds
    # Smooth, because clipping has no gradient beyond a bound, so learning would stall.
    return (high + low) / 2 + (high - low) / 2 * jnp.tanh(u)


def check_squash(bounds: Any, size: int, where: str) -> None:
    """Raise unless the bounds are finite and fit `size` controls, or are `None`."""
    for end in as_bounds(bounds, where, size=size) or ():
        if is_concrete(end) and not np.all(np.isfinite(end)):
            raise ValueError(
                f"{where}: bounds must be finite to squash into, got {end}."
            )


def mlp_policy(
    environment: Environment,
    width: int = 64,
    depth: int = 2,
    *,
    head: Literal["deterministic", "gaussian"] = "deterministic",
    key: PRNGKey,
) -> AbstractController:
    """A fully connected network with the numbers of inputs and outputs that an
    environment needs.

    The network acts on `environment.encode(y)`. If `environment.control_bounds` are
    finite, the network keeps the controls between these bounds by `tanh`.

    **Arguments:**

    - `environment`: the environment.
    - `width`: the number of units in a hidden layer, 64 by default.
    - `depth`: the number of hidden layers, 2 by default.
    - `head`: `"deterministic"` (default) or `"gaussian"`. With `"gaussian"`, the
        initial standard deviation of each control is a quarter of the range between its
        bounds, or 1 without bounds.
    - `key`: a random key for the initial weights.

    **Returns:** a [`delucax.controllers.MLP`][], or a
    [`delucax.controllers.Gaussian`][] whose mean is such a network.

    **Raises:** `ValueError` if `environment` is not an environment, `head` is unknown,
    a size is below 1 or no `key` is given.

    Source: Gradu, Hallman, Suo, Yu, Agarwal, Ghai, Singh, Zhang, Majumdar and Hazan,
    2021 (Deluca).

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        policy = dlx.controllers.mlp_policy(env, width=32, key=jax.random.key(0))
        dlx.rollout(env, policy, key=jax.random.key(1), x0=[0.1, 0.0]).total_cost
        ```

        ```text
        Array(1123., dtype=float32)
        ```
    """
    where = "mlp_policy"
    check_instance(environment, Environment, "environment", where)
    check_choice(head, ("deterministic", "gaussian"), "head", where)
    bounds = environment.control_bounds
    if bounds is not None:
        if not all(np.all(np.isfinite(end)) for end in bounds if is_concrete(end)):
            bounds = None
    size, encode = environment.control_size, environment.encode
    sizes = environment.feature_size, size, width, depth
    network = MLP(*sizes, features=encode, bounds=bounds, key=key)
    if head == "deterministic":
        return network
    std = jnp.ones(size)
    if bounds is not None:
        std = jnp.broadcast_to((bounds[1] - bounds[0]) / 4, (size,))
    # All bounds of the environment, also infinite ones, so that `log_prob` is the
    # log-probability of the applied control.
    return Gaussian(network, jnp.log(std), bounds=environment.control_bounds)


class GRU(AbstractController):
    r"""A gated recurrent unit (GRU): a network with a memory of past observations.

    $$h_k = \mathrm{cell}(\phi(y_k), h_{k-1}), \qquad u_k = A h_k + b$$

    The memory $h$ starts at zero in each episode. With bounds the control is

    $$u_k = \tfrac12 (\mathrm{high} + \mathrm{low}) +
    \tfrac12 (\mathrm{high} - \mathrm{low}) \tanh(A h_k + b)$$

    **Arguments:**

    - `in_size`, `out_size`, `features`, `bounds`, `key`: as in
        [`delucax.controllers.MLP`][].
    - `width`: the size of the memory, 32 by default.

    **Attributes:** `cell`, an `eqx.nn.GRUCell`, and `readout`, an `eqx.nn.Linear` with
    $A$ and $b$. Both are trainable.

    **Raises:** `ValueError` if a size is below 1, bounds are not finite or there is no
    key; at run time, if the size of the features is not `in_size`.

    Source: Cho et al., 2014.

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum")
        policy = dlx.controllers.GRU(
            3, 1, width=8, features=env.encode, bounds=(-2, 2), key=jax.random.key(0)
        )
        dlx.rollout(
            env, policy, key=jax.random.key(1), horizon=10, x0=[0.1, 0.0]
        ).total_cost
        ```

        ```text
        Array(0.097, dtype=float32)
        ```
    """

    cell: eqx.nn.GRUCell = weight()
    readout: eqx.nn.Linear = weight()
    features: Callable[[Array], Array] | None = function_field(of="y")
    bounds: tuple[Array, Array] | None = bounds_field("GRU")

    def __init__(
        self,
        in_size: int,
        out_size: int,
        width: int = 32,
        *,
        features: Callable[[Array], Array] | None = None,
        bounds: Any = None,
        key: PRNGKey,
    ):
        check_key(key, "GRU")
        in_size = check_count(in_size, "in_size", "GRU")
        out_size = check_count(out_size, "out_size", "GRU")
        width = check_count(width, "width", "GRU")
        self.cell, self.readout = _recurrent(in_size, out_size, width, key)
        self.features, self.bounds = features, bounds

    def __check_init__(self):
        check_squash(self.bounds, int(self.readout.out_features), "GRU")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        del key
        return jnp.zeros(self.cell.hidden_size, self.readout.weight.dtype)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        z = features_of(self, y, int(self.cell.input_size))
        after = self.cell(z.astype(state.dtype), state)
        return squash(self.readout(after), self.bounds).astype(y.dtype), after


@eqx.filter_jit
def _recurrent(
    in_size: int, out_size: int, width: int, key: PRNGKey
) -> tuple[eqx.nn.GRUCell, eqx.nn.Linear]:
    """A cell and a readout with initial weights."""
    cell_key, readout_key = jr.split(key)
    cell = eqx.nn.GRUCell(in_size, width, key=cell_key)
    return cell, eqx.nn.Linear(width, out_size, key=readout_key)


class Standardise(eqx.Module):
    r"""Features scaled to mean 0 and standard deviation 1, as inputs of a network.

    $$z = \operatorname{clip}((\phi(y) - \mu) / \sigma, -10, 10)$$

    Pass a `Standardise` as the `features` of a network. [`delucax.training.PPO`][] and
    [`delucax.training.SHAC`][] set `mean` and `std` of every `Standardise` in their
    model, from the observations during training.

    **Arguments:**

    - `mean`: $\mu$, a vector with an entry for each feature.
    - `std`: $\sigma$, a vector of positive numbers, or one number for all features; 1
        by default.
    - `features`: $\phi$, a function of an observation, such as `env.encode`; the
        observation itself by default.

    **Raises:** `ValueError` if `std` is not positive, or `mean` or `std` is not finite.

    !!! example

        ```python
        import delucax as dlx
        import jax
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        features = dlx.controllers.Standardise(jnp.zeros(3), [1, 1, 4], env.encode)
        policy = dlx.controllers.MLP(3, 1, features=features, key=jax.random.key(0))
        dlx.rollout(
            env, policy, key=jax.random.key(1), horizon=10, x0=[0.1, 0.0]
        ).total_cost
        ```

        ```text
        Array(0.903, dtype=float32)
        ```
    """

    mean: Array = parameter()
    std: Real = parameter(1.0)
    features: Callable[[Array], Array] | None = function_field(None, of="y")

    __repr__ = shown

    def __post_init__(self):
        mean, std = as_float_array(self.mean), as_float_array(self.std)
        if eqx.is_inexact_array(mean) and jnp.ndim(std) == 0:
            self.std = jnp.broadcast_to(std, mean.shape).astype(mean.dtype)

    def __check_init__(self):
        where, mean = "Standardise", self.mean
        check_vector(mean, "mean", where)
        check_positive(self.std, "std", where)
        if self.std.shape != mean.shape:
            raise ValueError(
                f"{where}: std must be a number or have shape {mean.shape}, got shape "
                f"{self.std.shape}."
            )

    def of(self, y: Array) -> Array:
        """The features before they are scaled.

        **Arguments:** `y`: an observation.

        **Returns:** a vector.
        """
        return y if self.features is None else jnp.asarray(self.features(y))

    def __call__(self, y: Array) -> Array:
        """The scaled features.

        **Arguments:** `y`: an observation.

        **Returns:** a vector.

        **Raises:** `ValueError` if `mean` has another size than the features.
        """
        features = self.of(y)
        if features.shape != self.mean.shape:
            raise ValueError(
                f"Standardise: mean must have an entry for each of the features, shape "
                f"{features.shape}, got shape {self.mean.shape}."
            )
        # Clipped at ten deviations as in OpenAI's Baselines, because of outliers.
        return jnp.clip((features - self.mean) / self.std, -10, 10)
