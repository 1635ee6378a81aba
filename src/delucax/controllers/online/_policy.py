"""The policies that are learned: maps from features to controls."""

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
"""Products of up to so many terms are one loop, not a call of a library each step."""


class AbstractPolicy(eqx.Module):
    """A family of maps `v = policy(theta, features)` and the set that `theta` is in."""

    @abc.abstractmethod
    def init(self) -> PyTree:
        """The first `theta`."""

    @abc.abstractmethod
    def at(self, theta: PyTree) -> "AbstractPolicy":
        """The same family, starting with `theta`."""

    @abc.abstractmethod
    def __call__(
        self, theta: PyTree, features: Float[Array, " f"]
    ) -> Float[Array, " m"]:
        """The control that is added to that of the base."""

    @abc.abstractmethod
    def project(self, theta: PyTree) -> PyTree:
        """The nearest point of the set."""

    def pull_back(
        self,
        theta: PyTree,
        response: Float[Array, "h o m"],
        features: Float[Array, "h f"],
    ) -> Float[Array, "o weights"]:
        """The derivative by theta, in one row, of `sum_h response_h v_h`, with `v_h`
        the control for the features of step h."""
        flat, unravel = ravel_pytree(theta)

        def outcome(flat):
            v = jax.vmap(self, in_axes=(None, 0))(unravel(flat), features)
            return jnp.einsum("hom,hm->o", response, v)

        # Few outcomes, many weights: reverse mode.
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
    """`v = network(features)`, where `theta` are the network's weights."""

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
    """The policy of an online learner, held fixed,

    `u_t = base(y_t) + policy(theta, features_t)`.

    `learner.fixed(theta)` makes it.
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
