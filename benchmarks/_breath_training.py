"""The same controller of a breath, trained in three ways in the same learned lung.

By the gradient through the simulator, by evolution strategies and by proximal policy
optimisation, each with several seeds at once. What counts is the error after as many
steps of the simulator.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import delucax as dlx
from delucax import lung
from delucax.training import ActorCritic, analytic, EvolutionStrategies, fit, PPO


PIPS = (10.0, 15.0, 20.0, 25.0, 30.0, 35.0)
LENGTH = 29
EPISODES = len(PIPS)
GRADIENT_STEPS = 400
BACKWARD = 3
"""What a gradient costs in steps of the simulator for each one forward."""
PAIRS = 16
BATCH, EPOCHS, MINIBATCHES = 48, 4, 3
NOISE = 0.2
MORE = 3.0
"""How many times the steps of the gradient the others take."""
_POPULATION = EvolutionStrategies(0.05, 2 * PAIRS)


class Asked(dlx.AbstractDynamics):
    """An inspiration of a lung that is told which pressure to reach.

    The state is that of the lung and the target; observed are the pressure, the target
    and how many steps have gone by.
    """

    lung: lung.LearnedLung

    control_names = ("u_in",)

    @property
    def dt(self):
        return self.lung.dt

    @property
    def state_names(self):
        return (*self.lung.state_names, "target")

    def advance(self, t, x, u, w):
        both = jnp.stack([u[0], jnp.zeros_like(u[0])])
        after, result = self.lung.advance(t, x[:-1], both, None)
        return jnp.append(after, x[-1]), result

    def observe(self, t, x):
        return jnp.stack([self.lung.pressure(x), x[-1], x[-2]])


class Miss(dlx.costs.AbstractCost):
    """How far the pressure is from the target."""

    lung: lung.LearnedLung

    def __call__(self, t, x, u):
        return jnp.abs(self.lung.pressure(x) - x[-1])


class Start(eqx.Module):
    """At rest, and a target of those that are trained at."""

    lung: lung.LearnedLung

    def __call__(self, key):
        return jnp.append(self.lung.resting(), jax.random.choice(key, jnp.array(PIPS)))


class Told(dlx.AbstractController):
    """A policy whose waveform rises to the target that is observed."""

    policy: lung.BreathPolicy

    def init(self, *, key=None):
        return self.policy.init(key=key)

    def __call__(self, t, y, state):
        return lung.BreathWaveform.at_pip(self.policy, y[1])(t, y[:1], state)

    def applied(self, u, cost, state):
        return self.policy.applied(u, cost, state)


class Error(eqx.Module):
    """The mean error of a policy over the pressures."""

    environment: dlx.Environment

    def __call__(self, policy, key):
        return jnp.mean(lung.breath_error(self.environment, policy, key=key))


def policy(key: Any) -> lung.BreathPolicy:
    """The controller before training."""
    return lung.BreathPolicy(lung.BreathWaveform(), 0.03, key=key)


def _by_gradient(error: Error, keys: Any, times: float, slope: Any, cost: int) -> Any:
    """`(steps of the simulator, errors)` while training, errors of shape `(n, seeds)`;
    with `times` the steps of the simulator that the plain gradient takes."""
    steps = max(1, round(times * BACKWARD * GRADIENT_STEPS / cost))
    optimiser = optax.adam(optax.cosine_decay_schedule(1e-2, steps))
    start = eqx.filter_vmap(policy)(keys)
    options: Any = dict(gradient=slope, progress=False)
    fitted = fit(error, start, optimiser, steps, key=keys, **options)
    each = cost * EPISODES * LENGTH
    taken = each * np.arange(1, steps + 1)
    model: Any = fitted.model
    last = _errors(error, model)
    # The loss of a step is of what the steps before have made.
    return taken, np.concatenate([np.asarray(fitted.history.loss)[1:], last[None]])


@eqx.filter_jit
def _judged(error, policies):
    return eqx.filter_vmap(lambda policy: error(policy, jax.random.key(7)))(policies)


def _errors(error: Error, policies: Any) -> np.ndarray:
    """Of each seed, with the noise of a fixed key."""
    return np.asarray(_judged(error, policies))


def _by_ppo(error: Error, keys: Any, times: float) -> Any:
    """As above, by proximal policy optimisation, judged without its noise."""
    model: Any = error.environment.dynamics.dynamics
    env = dlx.Environment(
        Asked(model),
        Miss(model),
        initial_state=Start(model),
        sensor_noise=dlx.disturbances.Gaussian(jnp.array([NOISE, 0.0, 0.0])),
        control_bounds=(jnp.zeros(1), jnp.array([100.0])),
        horizon=LENGTH,
    )

    def make(key):
        policy_key, critic_key = jax.random.split(key)
        drawn = dlx.controllers.Gaussian(
            Told(policy(policy_key)), jnp.log(10.0), bounds=env.control_bounds
        )
        seen = dlx.controllers.Standardise(jnp.zeros(3))
        critic = dlx.controllers.MLP(3, 1, width=32, features=seen, key=critic_key)
        return ActorCritic(drawn, critic)

    whole = times * BACKWARD * GRADIENT_STEPS * EPISODES * LENGTH
    batches = max(1, round(whole / (BATCH * LENGTH)))
    ppo = PPO(
        env,
        BATCH,
        epochs=EPOCHS,
        minibatches=MINIBATCHES,
        bootstrap=False,
        discount=1.0,
    )
    optimiser = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(1e-3))
    models = eqx.filter_vmap(make)(keys)
    taken, errors, done = [], [], 0
    for target in np.unique(np.geomspace(4, batches, 20).round().astype(int)):
        # Adam's memory begins anew with each piece, which are long.
        pieces = int(target) - done
        steps = pieces * EPOCHS * MINIBATCHES
        now = jax.vmap(lambda key, d=done: jax.random.fold_in(key, d))(keys)
        models = fit(ppo, models, optimiser, steps, key=now, progress=False).model
        done = int(target)
        taken.append(done * BATCH * LENGTH)
        errors.append(_errors(error, models.policy.base.policy))
    return np.array(taken), np.array(errors)


def _curve(way: Any, seeds: int, *options: Any) -> dict[str, Any]:
    """The error of a way over the steps of the simulator, some of them."""
    model: Any = lung.learned_lung().dynamics.dynamics
    error = Error(lung.learned_lung(model, noise=NOISE, horizon=LENGTH))
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
    steps, errors = way(error, keys, *options)
    keep = np.unique(np.geomspace(1, len(steps), 60).round().astype(int)) - 1
    errors = np.asarray(errors)[keep]
    print(f"{np.mean(errors[-1]):.2f} cmH2O after {steps[-1]:.3g} steps", flush=True)
    return {"steps": np.asarray(steps)[keep].tolist(), "errors": errors.tolist()}


WAYS = {
    "gradient": lambda seeds: _curve(_by_gradient, seeds, 1.0, analytic, BACKWARD),
    "evolution strategies": lambda seeds: _curve(
        _by_gradient, seeds, MORE, _POPULATION, 2 * PAIRS + 1
    ),
    "PPO": lambda seeds: _curve(_by_ppo, seeds, MORE),
}
"""How to train so many seeds, by name."""


def steps_to(curve: dict[str, Any], level: float) -> float | None:
    """After how many steps of the simulator the mean error is at most `level`."""
    means = np.mean(curve["errors"], axis=1)
    reached = np.flatnonzero(means <= level)
    return curve["steps"][reached[0]] if len(reached) else None
