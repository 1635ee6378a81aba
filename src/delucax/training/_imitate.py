"""Imitation of an expert: dataset aggregation (DAgger)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jaxtyping import Array, PyTree

from .._check import check_count, check_instance, check_key
from .._controller import AbstractController, check_controller, initial_state, replay
from .._results import RESULTS
from .._typing import PRNGKey
from ..environments import Environment
from ..simulation import rollout
from ._fit import fit, Fitted
from ._record import COLUMNS, History
from ._trainable import partition_trainable


_WHERE = "imitate"


class _Likeness(eqx.Module):
    """The mean squared distance between the controls of a policy and of the expert."""

    scale: Array

    def __call__(self, policy: AbstractController, batch: Any, key: PRNGKey) -> Array:
        def distance(t, y, u):
            own, _ = policy(t, y, policy.init(key=key))
            return jnp.sum(((own - u) / self.scale) ** 2)

        times, observations, controls, weights = batch
        distances = jax.vmap(distance)(times, observations, controls)
        distances = jnp.where(weights > 0, distances, 0)
        return jnp.sum(distances) / jnp.maximum(jnp.sum(weights), 1)


def imitate(
    environment: Environment,
    expert: AbstractController,
    policy: PyTree,
    *,
    key: PRNGKey,
    rounds: int = 4,
    episodes: int = 8,
    steps: int = 300,
    horizon: int | None = None,
    optimiser: optax.GradientTransformation | None = None,
    batch_size: int = 256,
    trainable: Any = None,
    progress: bool = True,
    throw: bool = True,
) -> Fitted:
    r"""Train a policy to act like an expert, such as MPC, by DAgger.

    DAgger stands for dataset aggregation. In the first round the expert runs the
    episodes. In every later round the policy runs the episodes, and the expert gives
    the control that it would have applied in each state. So the policy learns to
    recover from its own mistakes. Each round trains on the states of all rounds so far:

    $$\ell(\theta) = \operatorname{mean}_{(t, y)} \;
    \lVert S^{-1} (\pi_\theta(t, y) - u^*(t, y)) \rVert^2$$

    Here $\pi_\theta$ is the policy, $u^*$ the expert, and $S$ the diagonal matrix of
    the standard deviations of the expert's controls in the first round. For a control
    that is nearly constant, $S$ contains the largest of these standard deviations
    instead.

    **Arguments:**

    - `environment`: the environment.
    - `expert`: any controller. It may have a memory.
    - `policy`: the controller to train. It must have no memory.
    - `key`: a random key.
    - `rounds`: the number of rounds, 4 by default. A single round is behavioural
        cloning.
    - `episodes`: episodes in each round, 8 by default.
    - `steps`: steps of the optimiser in each round, 300 by default.
    - `horizon`: steps per episode; the `horizon` of the environment by default.
    - `optimiser`: an Optax optimiser, whose state is reset in each round; by default
        Adam with a cosine decay from 0.003.
    - `batch_size`: states in a batch, 256 by default.
    - `trainable`, `progress`, `throw`: as in [`delucax.training.fit`][].

    **Returns:** a [`delucax.training.Fitted`][]. The `history` of the result has the
    steps of all rounds, one round after the other.

    **Raises:** `ValueError` if an argument has the wrong type, the policy has a memory,
    or no control of the expert is finite. `RuntimeError` if training diverges, unless
    `throw` is false.

    Source: Ross, Gordon and Bagnell, 2011 (DAgger).

    !!! example

        ```python
        import delucax as dlx
        import jax

        env = dlx.make("pendulum", horizon=20)
        expert = dlx.controllers.local_lqr(env)
        policy = dlx.controllers.mlp_policy(env, 8, 1, key=jax.random.key(0))
        fitted = dlx.training.imitate(
            env, expert, policy, key=jax.random.key(1), rounds=2, steps=50
        )
        fitted.history.loss[-1]
        ```
    """
    check_instance(environment, Environment, "environment", _WHERE)
    check_controller(expert, "expert", _WHERE)
    check_controller(policy, "policy", _WHERE)
    key = check_key(key, _WHERE)
    given = dict(rounds=rounds, episodes=episodes, steps=steps, batch_size=batch_size)
    for name, count in given.items():
        check_count(count, name, _WHERE)
    # Before the expert runs, because that may take long.
    partition_trainable(policy, trainable, _WHERE)
    horizon = environment.horizon if horizon is None else horizon
    horizon = check_count(horizon, "horizon", _WHERE)
    if any(map(eqx.is_array, jax.tree.leaves(policy.init(key=key)))):
        raise ValueError(
            f"{_WHERE}: policy must have no memory, got a {type(policy).__name__} "
            "whose state holds arrays. Train it on the cost with delucax.training.fit."
        )
    if optimiser is None:
        optimiser = optax.adam(optax.cosine_decay_schedule(3e-3, steps))

    rows: Any = None
    histories, loss, result = [], None, None
    options: Any = dict(progress=progress, throw=throw, trainable=trainable)
    capacity = rounds * episodes * horizon
    options["batch_size"] = min(batch_size, capacity)
    for k in range(rounds):
        run_key, order_key, fit_key = jr.split(jr.fold_in(key, k), 3)
        keys = jr.split(run_key, episodes)
        driver = policy if k else expert
        *new, counts = jax.device_get(
            _watched(environment, driver, expert, keys, horizon)
        )
        # Steps that do not count may hold NaN. They are set to zero, because the
        # gradient of a NaN is NaN even with a weight of zero.
        new = [*(np.where(counts > 0, r.T, 0).T for r in new), counts]
        pairs = zip(rows or new, new, strict=True)
        rows = new if rows is None else [np.concatenate(pair) for pair in pairs]
        if loss is None:
            controls = rows[2][rows[3] > 0]
            if not len(controls):
                raise ValueError(
                    f"{_WHERE}: expert must have finite controls, got none in the "
                    "first round."
                )
            loss = _Likeness(jnp.asarray(_spread(controls)))
        # The rows are repeated up to a fixed size, so that later rounds do not compile
        # again. Which rows are repeated once more than the others is random.
        order = jr.permutation(order_key, len(rows[0]))
        at = np.resize(np.asarray(order), capacity)
        whole = tuple(r[at] for r in rows)
        fitted = fit(loss, policy, optimiser, steps, key=fit_key, data=whole, **options)
        policy = fitted.model
        # A failure in one round is not forgotten in the next.
        if result is None or bool(result == RESULTS.successful):
            result = fitted.result
        histories.append(fitted.history)
    return Fitted(policy, _one_after_another(histories), result)


@eqx.filter_jit
def _watched(environment, driver, expert, keys, horizon):
    """All steps of the episodes that `driver` runs: times, observations, controls of
    the expert, and 1 for the steps that count."""

    def episode(key):
        keep = ("observations", "controls", "costs")
        options: Any = dict(horizon=horizon, keep=keep, throw=False)
        run: Any = rollout(environment, driver, key=key, **options)
        *_, controller_key = environment.split_key(key)
        act = lambda t, y, state, u: expert(t, y, state)
        times, y = run.times[:-1], run.observations
        record = times, y, run.controls, run.costs
        controls = replay(expert, initial_state(expert, controller_key), record, act)
        finite = jnp.all(jnp.isfinite(jnp.concatenate([y, controls], axis=1)), axis=1)
        counts = finite & (jnp.arange(horizon) < run.length)
        return times, y, controls, counts.astype(y.dtype)

    return [r.reshape(-1, *r.shape[2:]) for r in jax.vmap(episode)(keys)]


def _spread(controls: np.ndarray) -> np.ndarray:
    """The standard deviations of the controls. An entry that is nearly constant has the
    largest of them: its own would outweigh the other entries."""
    std = controls.std(axis=0)
    most = std.max() or 1
    return np.where(std > 1e-3 * most, std, most)


def _one_after_another(histories: list[History]) -> History:
    """The histories of several runs, joined as those of a single run."""
    columns = {n: np.concatenate([h[n] for h in histories]) for n in COLUMNS}
    lengths = np.cumsum([0, *map(len, histories[:-1])])
    last = np.cumsum([0, *(h.seconds[-1] for h in histories[:-1])])
    for name, before in (("step", lengths), ("seconds", last)):
        columns[name] = np.concatenate(
            [h[name] + b for h, b in zip(histories, before, strict=True)]
        )
    return History(**columns, metrics={})
