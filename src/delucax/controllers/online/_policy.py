"""The policies that an online learner learns: maps from features to controls."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..._check import check_step
from ..._controller import AbstractController
from ..._module import parameter, weight
from ..._typing import PRNGKey, RealScalar
from ...math._norms import within_ball
from ._closed_loop import ClosedLoop


_FUSED = 8192
"""Up to this size, a sum of products compiles to one loop, which is faster."""


class AbstractPolicy(eqx.Module):
    """A family of maps `v = policy(theta, features)`, and a set of allowed `theta`."""

    @abc.abstractmethod
    def init(self) -> PyTree:
        """The initial `theta`."""

    @abc.abstractmethod
    def at(self, theta: PyTree) -> "AbstractPolicy":
        """The same family, with `theta` as the initial one."""

    @abc.abstractmethod
    def __call__(
        self, theta: PyTree, features: Float[Array, " f"]
    ) -> Float[Array, " m"]:
        """The control that is added to the control of the base."""

    @abc.abstractmethod
    def project(self, theta: PyTree) -> PyTree:
        """The nearest allowed `theta`."""

    def pull_back(
        self,
        theta: PyTree,
        response: Float[Array, "h o m"],
        features: Float[Array, "h f"],
    ) -> Float[Array, "o weights"]:
        """The derivative of `sum_h response_h v_h` with respect to theta, in one row.

        Here `v_h` is the control for the features of step `h`.
        """
        flat, unravel = ravel_pytree(theta)

        def outcome(flat):
            v = jax.vmap(self, in_axes=(None, 0))(unravel(flat), features)
            return jnp.einsum("hom,hm->o", response, v)

        # Reverse mode, because there are few outcomes and many weights.
        return jax.jacrev(outcome)(flat)


class LinearPolicy(AbstractPolicy):
    """`v = theta features`, with the Frobenius norm of `theta` at most `radius`."""

    start: Float[Array, "m f"] = weight()
    radius: Array = parameter()

    def __check_init__(self):
        check_step(self.radius, "LinearPolicy", "radius")

    def init(self):
        return self.start

    def at(self, theta):
        return LinearPolicy(theta, self.radius)

    def __call__(self, theta, features):
        return theta @ features

    def project(self, theta):
        return within_ball(theta, self.radius)

    def pull_back(self, theta, response, features):
        h, o, m = response.shape
        # The derivative of `a' theta f` by theta is the outer product a f'.
        if h * o * m * features.shape[1] > _FUSED:
            rows = jnp.einsum("hom,hf->omf", response, features)
        else:
            rows = jnp.sum(response[..., None] * features[:, None, None], axis=0)
        return rows.reshape(o, theta.size)


class NetworkPolicy(AbstractPolicy):
    """`v = network(features)`, where `theta` is the weights of the network."""

    start: eqx.nn.MLP = weight()

    def init(self):
        return eqx.filter(self.start, eqx.is_inexact_array)

    def at(self, theta):
        return NetworkPolicy(eqx.combine(theta, self.start))

    def __call__(self, theta, features):
        return eqx.combine(theta, self.start)(features)

    def project(self, theta):
        return theta


class FixedPolicy(AbstractController):
    r"""The policy of an online learner, which no longer learns.

    $$u_t = \mathrm{base}(y_t) + \mathrm{policy}(\theta, \phi_t)$$

    Here $\phi_t$ are the features. `learner.fixed(theta)` makes one.
    """

    loop: ClosedLoop
    policy: AbstractPolicy

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        return self.loop.init(key, 0)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        policy = lambda features: self.policy(self.policy.init(), features)
        _, v, state = self.loop.act(self, t, y, state, policy)
        return (state.u_base + v).astype(y.dtype), state

    def applied(self, u: Array, cost: Array, state: PyTree) -> PyTree:
        return self.loop.applied(u, cost, state)
