"""The policies that `synthesise` trains."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array

from ..._controller import AbstractController
from ..._typing import PRNGKey
from ...controllers import (
    Constant,
    GRU,
    LQG,
    LQR,
    MLP,
    Residual,
    Standardise,
    Zero,
)
from ...environments import Environment
from ...simulation import rollout
from ._episode_costs import is_hidden


# Episodes of each constant control and of the law, for the scales of features and
# controls.
_EPISODES = 32


def structures(
    environment: Environment,
    law: LQR | LQG | None,
    is_family: bool,
    width: int,
    depth: int,
    key: PRNGKey,
) -> dict[str, Residual]:
    """Policies to train, by name: a network that corrects the LQR, if there is one, and
    a network alone.

    For a family of plants, the first network is recurrent, and without an LQR it is the
    whole policy. If the state is hidden, both networks are recurrent, and the first one
    corrects the LQG.

    The first policy starts as the LQR. The others have its form, with a gain of zero,
    so that all run in the same compiled programs. `simplified` undoes this.
    """
    visits_key, plain_key, residual_key = jr.split(key, 3)
    m, bounds = environment.control_size, environment.control_bounds
    low, high = (jnp.full(m, -jnp.inf), jnp.full(m, jnp.inf))
    if bounds is not None:
        low, high = (jnp.broadcast_to(jnp.asarray(e, float), m) for e in bounds)
    bounded = jnp.isfinite(high - low)

    held = [jnp.where(jnp.isfinite(end), end, 0) for end in (low, high)]
    constants = jnp.stack([jnp.zeros(m), *held])
    seen, applied = _visits(
        environment, law, constants, jr.split(visits_key, _EPISODES)
    )
    features = _standardised(environment, seen)
    # A control without bounds gets a range from the controls of the law, or [-2, 2].
    centre, reach = (np.zeros(m), np.ones(m)) if law is None else _range(applied)
    half = jnp.where(bounded, (high - low) / 2, 2 * reach)
    # With a bound on one side only, the range begins at that bound.
    below = jnp.where(jnp.isfinite(high), high - 2 * half, centre - half)
    above = jnp.where(jnp.isfinite(low), low + 2 * half, centre + half)
    ends = (
        jnp.where(jnp.isfinite(low), low, below),
        jnp.where(jnp.isfinite(high), high, above),
    )

    size = environment.feature_size
    free: Any = bounds and tuple(
        jnp.full_like(end, limit)
        for end, limit in zip(bounds, (-jnp.inf, jnp.inf), strict=True)
    )
    network = lambda bounds, key: MLP(
        size, m, width, depth, features=features, bounds=bounds, key=key
    )
    memory = lambda bounds, key: GRU(
        size, m, width, features=features, bounds=bounds, key=key
    )
    hidden = is_hidden(environment)
    recurrent = is_family or hidden
    made: dict[str, Any] = {}
    if hidden or is_family and law is None:
        made["memory"] = memory(ends, plain_key)
    if not hidden:
        made["network"] = network(ends, plain_key)
    if law is None:
        base: Any = Zero(m)
    else:
        base = eqx.tree_at(_gains, law, replace_fn=jnp.zeros_like)
    made = {name: Residual(base, policy, free) for name, policy in made.items()}
    if law is None:
        return made

    # The last layer starts at zero, so the policy starts as the law.
    correction = (memory if recurrent else network)((-half, half), residual_key)
    last: Any = lambda c: c.readout if recurrent else c.network.layers[-1]
    zero = jax.tree.map(jnp.zeros_like, last(correction))
    correction = eqx.tree_at(last, correction, zero)
    name = f"{type(law).__name__} + {'memory' if recurrent else 'network'}"
    return {name: Residual(law, correction, bounds)} | made


def simplified(structure: str, policy: AbstractController) -> AbstractController:
    """A policy of this structure, without the part that is zero."""
    if not isinstance(policy, Residual) or "+" in structure:
        return policy
    return policy.base if structure in ("LQR", "LQG") else policy.correction


def _gains(law: Any) -> tuple[Any, Any]:
    """The gain of an LQR or LQG, and the control at its operating point."""
    regulator = law.regulator if isinstance(law, LQG) else law
    return regulator.K, regulator.u_ref


@eqx.filter_jit
def _visits(
    environment: Environment, law: Any, constants: Array, keys: Array
) -> tuple[Array, Array | None]:
    """The observations under constant controls and under the law, a row for each step,
    and the controls of the law."""
    keep = ("observations", "controls")

    def rows(driver, key):
        run: Any = rollout(environment, driver, key=key, keep=keep, throw=False)
        return run.observations, run.controls

    def each(driver, given):
        """The rows of a driver for each value given, from all keys."""
        one = lambda value: jax.vmap(lambda key: rows(driver(value), key))(keys)
        return jax.vmap(one)(given)

    flat = lambda rows: rows.reshape(-1, rows.shape[-1])
    if law is None:
        return flat(each(Constant, constants)[0]), None
    # All are the same law with other gains, so that there is one rollout to compile.
    K, u_ref = _gains(law)
    held = jnp.concatenate(
        [jnp.zeros_like(K, shape=(len(constants), *K.shape)), K[None]]
    )
    gains = held, jnp.concatenate([constants, u_ref[None]])
    y, u = each(lambda gains: eqx.tree_at(_gains, law, gains), gains)
    return flat(y), flat(u[-1])


@eqx.filter_jit
def _encoded(environment: Environment, observations: Array) -> Array:
    return jax.vmap(environment.encode)(observations)


def _standardised(environment: Environment, observations: Array) -> Standardise:
    """Features that are standardised with the median and spread of `observations`."""
    z = np.asarray(_encoded(environment, observations))
    centre = np.median(z[np.all(np.isfinite(z), axis=1)], axis=0)
    std = _spread(z, 1e-3)
    return Standardise(jnp.asarray(centre), jnp.asarray(std), environment.encode)


def _range(applied: Any) -> tuple[np.ndarray, np.ndarray]:
    """The median and the spread of the controls of a law. Where these hardly vary, they
    do not tell how large a control may be, and the spread is 1."""
    u, least = np.asarray(applied), 1e-3
    u = u[np.all(np.isfinite(u), axis=1)]
    centre, spread = np.median(u, axis=0), _spread(u, least)
    is_known = spread > 2 * least * (1 + np.abs(centre))
    return centre, np.where(is_known, spread, 1.0)


def _spread(rows: np.ndarray, least: float) -> np.ndarray:
    """The standard deviation by quantiles, because some episodes run away."""
    rows = rows[np.all(np.isfinite(rows), axis=1)]
    low, high = np.quantile(rows, [0.1, 0.9], axis=0)
    # 80% of a normal distribution are within 1.28 standard deviations of the mean.
    return np.maximum((high - low) / 2.56, least * (1 + np.abs(low)))
