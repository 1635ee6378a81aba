"""Every controller, for what all of them must do."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import delucax as dlx


c = dlx.controllers
DT = 0.1
A = np.array([[1.0, DT], [0.3 * DT, 0.98]])
B = np.array([[0.0], [DT]])
FEEDBACK = np.array([[1.0, 1.5]])


class Case(NamedTuple):
    """`make(size)` is the controller with its numbers near `size` times some others."""

    make: Any
    reads_all: bool = True  # whether an observation of the wrong size is an error


def lqr(size):
    return c.LQR(dlx.LinearDynamics(A, B, dt=DT), size * jnp.eye(2), jnp.eye(1))


def hinfinity(size, horizon=None):
    dynamics = dlx.LinearDynamics(A, B, dt=DT)
    weights = size * jnp.eye(2), jnp.eye(1)
    return c.HInfinity(dynamics, *weights, gamma=100.0, horizon=horizon)


def ramp(t):
    return jnp.stack([0.1 * t, 0.1 + 0 * t])


def finite(size):
    dynamics, eye = dlx.LinearDynamics(A, B, dt=DT), jnp.eye(2)
    options = dict(final=size * eye, horizon=12, reference=ramp)
    return c.FiniteHorizonLQR(dynamics, size * eye, jnp.eye(1), **options)


def lqi(size):
    dynamics = dlx.LinearDynamics(A, B, dt=DT)
    output, target = jnp.eye(1, 2), jnp.array([0.2])
    return c.LQI(
        dynamics, size * jnp.eye(3), jnp.eye(1), output=output, reference=target
    )


def ahead(size):
    dynamics = dlx.LinearDynamics(A, B, dt=DT)
    signals = dict(reference=[0.1 * size, 0.0], disturbance=[0.0, 0.1], preview=2)
    return c.LQR(dynamics, size * jnp.eye(2), jnp.eye(1), **signals)


def lqg(size, **options):
    noise = 0.05 * size * jnp.eye(2), 0.1 * jnp.eye(2)
    dynamics = dlx.LinearDynamics(A, B, dt=DT)
    return c.LQG(dynamics, size * jnp.eye(2), jnp.eye(1), *noise, **options)


def estimated(kind, size):
    noise = 0.05 * size * jnp.eye(2), 0.1 * jnp.eye(2)
    filtered = kind(dlx.LinearDynamics(A, B, dt=DT), *noise, covariance=noise[0])
    return c.OutputFeedback(c.PID(size, 2.0, dt=DT, output=[[1.0, 0.1]]), filtered)


def moving(*given, **options):
    return dlx.estimators.MHE(*given, 3, robust=0.5, **options)


def mlp(size, in_size=2, features=None):
    key = jax.random.key(int(10 * size))
    options = dict(features=features, bounds=(-2.0 * size, 2.0), key=key)
    return c.MLP(in_size, 1, width=4, depth=2, **options)


def choosing(size):
    logits = c.MLP(2, 3, width=4, depth=1, key=jax.random.key(int(10 * size)))
    return c.Categorical(logits, size * jnp.array([[-1.0], [0.0], [1.0]]))


def learner(kind, size, **options):
    """As fast as it need be for its weights to matter."""
    dynamics = dlx.LinearDynamics(A, B, dt=DT)
    cost = dlx.costs.Quadratic(size * jnp.eye(2), 0.1 * jnp.eye(1))
    options = dict(horizon=3, learning_rate=size) | options
    return kind(dynamics, cost, **options)


def swing(size):
    """A learner that linearises along the way."""
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=DT)
    cost = dlx.costs.Quadratic(size * jnp.eye(2), 0.1 * jnp.eye(1))
    base = c.Linear(size * jnp.array([[20.0, 5.0]]))
    return c.drc(dynamics, cost, base=base, memory=2, horizon=3, learning_rate=size)


def network(size):
    key = jax.random.key(int(10 * size))
    return learner(c.neural_gpc, size, memory=2, width=3, key=key)


def bandit(size):
    dynamics = dlx.LinearDynamics(A, B, dt=DT)
    options = dict(memory=2, horizon=3, learning_rate=size, delta=size)
    return c.BPC(dynamics, c.Linear(size * FEEDBACK), **options)


def build(model):
    cost = dlx.costs.Quadratic(jnp.eye(2), 0.1 * jnp.eye(1))
    # A base by default is a Riccati equation, which the case `LQR` has.
    base = c.Linear(FEEDBACK)
    return c.gpc(model, cost, base=base, memory=2, horizon=3)


def explorer(size):
    return c.Explore(build, size * FEEDBACK, steps=5, scale=2 * size, dt=DT)


def scheduled(size):
    gains = size * jnp.linspace(1, 2, 5)
    return c.Scheduled(eqx.filter_vmap(lambda g: c.Linear(g * FEEDBACK))(gains), DT)


def scheduled_pid(size):
    make = lambda kp: c.PID(kp, 2.0, 0.3, dt=DT, output=[[1.0, 0.1]])
    return c.Scheduled(eqx.filter_vmap(make)(size * jnp.linspace(1, 2, 5)), DT)


def receding(size, **options):
    cost = dlx.costs.Quadratic(size * jnp.eye(2), 0.1 * jnp.eye(1), final=jnp.eye(2))
    return c.MPC(dlx.LinearDynamics(A, B, dt=DT), cost, 4, **options)


def drawn(size):
    planner = dlx.planning.MPPI(8, 1, scale=2.0, temperature=size)
    # Constant controls would tie with a plan of them a step later: the cheaper of two
    # starts has a kink there.
    start = jnp.array([[0.1], [-0.2], [0.3], [0.1]])
    return receding(size, planner=planner, start=start)


class Below(eqx.Module):
    """A barrier on the first state and the speed."""

    level: jax.Array = dlx.parameter()

    def __call__(self, t, x):
        return self.level + 0.1 * t - x[0] - 0.3 * x[1]


def filtered(size):
    plant = dlx.systems.LinearSystem([[0.0, 1.0], [0.3, -0.2]], [[0.0], [1.0]])
    options = dict(decay=2 * size, price=50 * size, bounds=(-20.0, 20.0))
    options["degrees"] = 1  # it is made while it is traced
    return c.SafetyFilter(c.Linear(FEEDBACK), plant, Below(0.1 * size), **options)


def filtered_in_steps(size):
    plant = dlx.LinearDynamics(A, B, dt=DT)
    barriers = {"below": Below(0.2 * size), "above": above}
    options = dict(decay=0.3 * size, disturbance=0.01 * size, weight=size, degrees=1)
    return c.SafetyFilter(c.Linear(FEEDBACK), plant, barriers, **options)


def above(t, x):
    return x[1] + 0.3


def features(y):
    return jnp.stack([y[0], y[1], y[0] * y[1]])


CASES = {
    "Zero": Case(lambda size: c.Zero(1), reads_all=False),
    "Constant": Case(lambda size: c.Constant([size]), reads_all=False),
    "Random": Case(lambda size: c.Random([size], 0.1), reads_all=False),
    "OpenLoop": Case(lambda size: c.OpenLoop(size * jnp.ones((4, 1))), False),
    "Linear": Case(lambda size: c.Linear(size * FEEDBACK)),
    "LQR": Case(lqr),
    "LQR that looks ahead": Case(ahead),
    "FiniteHorizonLQR": Case(finite),
    "LQI": Case(lqi),
    "LQG": Case(lqg),
    "LQG from the start": Case(lambda size: lqg(size, steady_state=False)),
    "OutputFeedback": Case(
        lambda size: estimated(dlx.estimators.ExtendedKalmanFilter, size)
    ),
    "OutputFeedback of an unscented filter": Case(
        lambda size: estimated(dlx.estimators.UnscentedKalmanFilter, size)
    ),
    "OutputFeedback of a moving horizon": Case(lambda size: estimated(moving, size)),
    "HInfinity": Case(hinfinity),
    "HInfinity over a horizon": Case(lambda size: hinfinity(size, horizon=8)),
    "PID": Case(lambda size: c.PID(size, 2 * size, 0.3, dt=DT, output=[[1.0, 0.1]])),
    "PID on an index": Case(
        lambda size: c.PID([size], 2.0, 0.3, dt=DT, output=0, reference=0.1 * size),
        reads_all=False,
    ),
    "LeakyPID": Case(lambda size: c.LeakyPID(size, dt=DT, output=[[1.0, 0.1]])),
    "MLP": Case(mlp),
    "MLP of features": Case(lambda size: mlp(size, 3, features), reads_all=False),
    "Gaussian": Case(lambda size: c.Gaussian(c.Linear(size * FEEDBACK), [-1.0])),
    "Gaussian of PID": Case(
        lambda size: c.Gaussian(
            c.PID(size, 2.0, dt=DT, output=[[1.0, 0.1]]), -1.0, bounds=(-9.0, 9.0)
        )
    ),
    "GRU": Case(lambda size: c.GRU(2, 1, 3, key=jax.random.key(int(10 * size)))),
    "History": Case(lambda size: c.History(mlp(size, 5), 2, 1)),
    "Categorical": Case(choosing, reads_all=False),
    "Categorical, greedy": Case(lambda size: choosing(size).greedy, reads_all=False),
    "Scheduled": Case(scheduled),
    "Scheduled PID": Case(scheduled_pid),
    "Residual": Case(
        lambda size: c.Residual(c.Linear(size * FEEDBACK), mlp(size), (-1.0, 1.0))
    ),
    "GPC": Case(lambda size: learner(c.gpc, size, memory=2)),
    "DRC": Case(lambda size: learner(c.drc, size, memory=2)),
    "DRC along the way": Case(swing),
    "SFC": Case(lambda size: learner(c.sfc, size, memory=4, filters=2)),
    "DSC": Case(lambda size: learner(c.sfc, size, memory=3, filters=1, double=True)),
    "NeuralGPC": Case(network),
    "GPC, fixed": Case(
        lambda size: learner(c.gpc, size, memory=2).fixed(size * jnp.ones((1, 4)))
    ),
    "Adaptive": Case(
        lambda size: c.Adaptive(learner(c.gpc, size, memory=2), slots=2, every=3)
    ),
    "BPC": Case(bandit),
    "Explore": Case(explorer),
    "MPC": Case(receding),
    "MPC that samples": Case(drawn),
    "SafetyFilter": Case(filtered),
    "SafetyFilter in steps": Case(filtered_in_steps),
}
