"""Random closed loops against a plain loop in NumPy, in double precision.

A composition draws a plant (field, kind of disturbance, solver, substeps, step),
wrappers around it, a disturbance, sensor noise, bounds, termination and a precision.
Its twin is the few lines of NumPy that a reader would write for it.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from helpers import assert_close, minutes, needs_x64, once, user_error
from hypothesis import given, HealthCheck, Phase, settings, strategies as st

import delucax as dlx


Advance = Callable[[float, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Twin(NamedTuple):
    """Dynamics in NumPy: of `n` states, with `k` disturbances."""

    advance: Advance
    observe: Callable[[float, np.ndarray], np.ndarray]
    n: int
    k: int


# The plant: a driven, damped spring that stiffens, observed through a mixing of states.

GAINS = np.array([[1.0, 0.3], [-0.2, 0.8]])
PUSH = np.array([[0.4, 0.1], [-0.3, 0.5]])


def acceleration(xp, t, x, u, stiffness):
    drive = 0.5 * xp.sin(2 * t) + u[0]
    return drive - stiffness * x[0] - 0.3 * x[0] ** 3 - 0.4 * x[1]


class Spring(dlx.AbstractSystem):
    state_names, control_names = ("x", "v"), ("force",)
    stiffness: jax.Array = dlx.parameter(1.3)
    mixes: bool = eqx.field(static=True, default=False)

    def vector_field(self, t, x, u, w):
        return jnp.stack([x[1], acceleration(jnp, t, x, u, self.stiffness)])

    def observe(self, t, x):
        return jnp.asarray(GAINS, x.dtype) @ x if self.mixes else x

    def equilibrium(self):
        return jnp.zeros(2), jnp.zeros(1)


class Pushed(Spring):
    """A spring that two disturbances push, inside the field."""

    disturbance_names = ("a", "b")

    def vector_field(self, t, x, u, w):
        a = acceleration(jnp, t, x, u, self.stiffness)
        return jnp.stack([x[1], a]) + jnp.asarray(PUSH, x.dtype) @ w


class Shaky(Spring):
    """A spring in a Brownian bath."""

    def diffusion(self, t, x, u):
        return jnp.stack([0.1 + 0.0 * x[0], 0.2 * jnp.cos(x[0])])


def explicit_step(tableau):
    """One step of an explicit Runge-Kutta method."""

    def step(f, t, x, h):
        slopes = []
        for c, row in tableau[0]:
            stage = x + h * sum((a * k for a, k in zip(row, slopes, strict=True)), 0.0)
            slopes.append(f(t + c * h, stage))
        return x + h * sum(b * k for b, k in zip(tableau[1], slopes, strict=True))

    return step


def implicit_euler(f, t, x, h):
    y = x
    for _ in range(200):  # a contraction, as h is small
        y = x + h * f(t + h, y)
    return y


def finely(f, t, x, h):
    for i in range(50):
        x = RK4(f, t + i * h / 50, x, h / 50)
    return x


RK4 = explicit_step(
    (
        [(0.0, []), (0.5, [0.5]), (0.5, [0.0, 0.5]), (1.0, [0.0, 0.0, 1.0])],
        [1 / 6, 1 / 3, 1 / 3, 1 / 6],
    )
)
EULER = explicit_step(([(0.0, [])], [1.0]))
HEUN = explicit_step(([(0.0, []), (1.0, [1.0])], [0.5, 0.5]))

TIGHT = dict(rtol=1e-9, atol=1e-9), dict(rtol=1e-6, atol=1e-6)
SOLVERS: dict[str, tuple[Callable, Callable]] = {
    "RK4": (lambda: {}, RK4),
    "Euler": (lambda: dict(solver=diffrax.Euler()), EULER),
    "Heun": (lambda: dict(solver=diffrax.Heun()), HEUN),
    "ImplicitEuler": (lambda: dict(solver=diffrax.ImplicitEuler()), implicit_euler),
    "adaptive": (
        lambda: dict(
            solver=diffrax.Tsit5(),
            stepsize_controller=diffrax.PIDController(
                **TIGHT[0 if jax.config.jax_enable_x64 else 1]
            ),
        ),
        finely,
    ),
}


def spring(kind, solver, substeps, dt, mixes) -> tuple[Any, Twin]:
    """A plant and its twin; `kind` says how a disturbance enters."""
    system = {"added": Spring, "field": Pushed, "brownian": Shaky}[kind](mixes=mixes)
    options, step = SOLVERS[solver]
    adaptive = solver == "adaptive"
    if kind == "brownian":
        options, step, adaptive = dict, EULER, False
    substeps = 1 if adaptive else substeps
    h = dt / substeps

    def advance(t, x, u, w):
        pushed = PUSH @ w if kind == "field" else 0.0

        def field(t, x):
            return np.array([x[1], acceleration(np, t, x, u, 1.3)]) + pushed

        increments = w.reshape(substeps, 2) if kind == "brownian" else None
        for i in range(substeps):
            x_next = step(field, t + i * h, x, h)
            if increments is not None:
                x_next = x_next + np.array([0.1, 0.2 * np.cos(x[0])]) * increments[i]
            x = x_next
        return x + w if kind == "added" else x

    plant = dlx.Discretized(system, dt, substeps=substeps, **options())
    observe = lambda t, x: GAINS @ x if mixes else x
    return plant, Twin(advance, observe, 2, 2 * (substeps if increments(kind) else 1))


def increments(kind):
    return kind == "brownian"


def linear(seed, dt) -> tuple[Any, Twin]:
    """Linear dynamics about a point that moves, with `C` and `E`, varying in time."""
    rng = np.random.default_rng(seed)
    A, B, E = (rng.normal(size=(40, 2, k)) / 3 for k in (2, 1, 3))
    C, x_ref, u_ref = rng.normal(size=(2, 2)), rng.normal(size=2), rng.normal(size=1)
    plant = dlx.LinearDynamics(A, B, C, E, dt=dt, x_ref=x_ref, u_ref=u_ref)

    def advance(t, x, u, w):
        k = round(t / dt)
        return x_ref + A[k] @ (x - x_ref) + B[k] @ (u - u_ref) + E[k] @ w

    return plant, Twin(advance, lambda t, x: C @ x, 2, 3)


# Wrappers.


class Weak(dlx.dynamics.AbstractWrapper):
    """A user's own wrapper: part of the control is lost."""

    dynamics: dlx.AbstractDynamics

    def advance(self, t, x, u, w):
        return self.dynamics.advance(t, x, 0.7 * u, w)


def weak(plant, twin, rng):
    def advance(t, x, u, w):
        return twin.advance(t, x, 0.7 * u, w)

    return Weak(plant), twin._replace(advance=advance)


def attacked(plant, twin, rng):
    L = 0.1 * rng.normal(size=(twin.k, twin.n))
    bound = rng.choice([0.05, 10.0])
    x_ref = np.asarray(plant.equilibrium()[0], np.float64)

    def advance(t, x, u, w):
        added = L @ (x - x_ref)
        size = np.linalg.norm(added)
        return twin.advance(t, x, u, w + added * min(1, bound / max(size, 1e-30)))

    wrapped = dlx.dynamics.WorstCase(plant, L, bound=bound)
    return wrapped, twin._replace(advance=advance)


def delayed(plant, twin, rng):
    late, blind = (int(n) for n in rng.integers(0, 3, 2))
    n, p = twin.n, len(twin.observe(0.0, np.zeros(twin.n)))

    def cut(x):
        return x[:n], x[n : n + late], x[n + late :].reshape(blind, p)

    def advance(t, x, u, w):
        own, controls, outputs = cut(x)
        acting = controls[-1:] if late else u
        after = twin.advance(t, own, acting, w)
        controls = np.concatenate([u, controls])[:late]
        outputs = np.concatenate([twin.observe(t, own)[None], outputs])[:blind]
        return np.concatenate([after, controls, outputs.ravel()])

    def observe(t, x):
        own, _, outputs = cut(x)
        return outputs[-1] if blind else twin.observe(t, own)

    wrapped = dlx.dynamics.Delayed(plant, controls=late, sensor=blind)
    return wrapped, Twin(advance, observe, n + late + blind * p, twin.k)


WRAPPERS = {"weak": weak, "attacked": attacked, "delayed": delayed}


# Disturbances; a twin takes the indices of the steps. What is random is taken as drawn.


def shock(k, dt, rng):
    start, count = int(rng.integers(0, 6)), int(rng.integers(0, 6))
    value = rng.normal(size=k)
    there = dlx.disturbances.shock(value, start=start * dt, duration=count * dt)
    on = lambda i: (i >= start) & (i < start + count)
    return there, lambda i: on(i)[:, None] * value


def square(k, dt, rng):
    half = int(rng.integers(1, 4))
    there = dlx.disturbances.Square(0.3, period=2 * half * dt, size=k)
    return (
        there,
        lambda i: np.where(i % (2 * half) < half, 0.3, -0.3)[:, None] + (np.zeros(k)),
    )


def sinusoid(k, dt, rng):
    f, phase = rng.uniform(0.1, 2), rng.normal(size=k)
    there = dlx.disturbances.Sinusoid(0.2, f, phase=phase, offset=0.1)
    return there, lambda i: 0.2 * np.sin(2 * np.pi * f * i[:, None] * dt + phase) + 0.1


def sum_of_two(k, dt, rng):
    (one, first), (other, second) = shock(k, dt, rng), square(k, dt, rng)
    return one + other, lambda i: first(i) + second(i)


def gaussian(k, dt, rng):
    return dlx.disturbances.Gaussian(0.2, size=k), None


def window_of_uniform(k, dt, rng):
    uniform = dlx.disturbances.Uniform(-0.3, 0.3, size=k)
    return uniform.between(2 * dt, 6 * dt), None


def default(k, dt, rng):
    return None, None


DISTURBANCES = {
    f.__name__: f
    for f in (shock, square, sinusoid, sum_of_two, gaussian, window_of_uniform, default)
}


class Feedback(dlx.AbstractController):
    """Linear in what is observed, with a memory of the control that was applied."""

    K: jax.Array = dlx.weight()

    def init(self, *, key=None):
        return jnp.zeros(1), jnp.zeros((), jnp.int32)

    def __call__(self, t, y, state):
        last, count = state
        u = -self.K @ y + 0.3 * last + 0.1 * count
        return u.astype(y.dtype), (last, count + 1)

    def applied(self, u, cost, state):
        return u.astype(state[0].dtype), state[1]


class Composition(NamedTuple):
    kind: str
    solver: str
    substeps: int
    dt: float
    mixes: bool
    wrappers: tuple[str, ...]
    disturbance: str
    noise: float
    bound: float | None
    ends: str | None
    single: bool
    seed: int


compositions = st.builds(
    Composition,
    kind=st.sampled_from(["added", "field", "brownian", "linear"]),
    solver=st.sampled_from(sorted(SOLVERS)),
    substeps=st.integers(1, 3),
    dt=st.floats(1e-3, 0.1),
    mixes=st.booleans(),
    wrappers=st.lists(st.sampled_from(sorted(WRAPPERS)), max_size=3).map(tuple),
    disturbance=st.sampled_from(sorted(DISTURBANCES)),
    noise=st.sampled_from([0.0, 0.1]),
    bound=st.sampled_from([None, 0.3]),
    ends=st.sampled_from([None, "time", "state"]),
    single=st.booleans(),
    seed=st.integers(0, 2**16),
)

HORIZON = 12


def build(c: Composition) -> tuple[Any, Any, Twin, Any, np.ndarray]:
    """An environment and a controller; a twin of the dynamics and of the disturbance,
    and a start."""
    rng = np.random.default_rng(c.seed)
    if c.kind == "linear":
        plant, twin = linear(c.seed, c.dt)
    else:
        plant, twin = spring(c.kind, c.solver, c.substeps, c.dt, c.mixes)
    for name in c.wrappers:
        plant, twin = WRAPPERS[name](plant, twin, rng)
    assert (plant.state_size, plant.disturbance_size) == (twin.n, twin.k)
    disturbance, known = DISTURBANCES[c.disturbance](twin.k, c.dt, rng)
    p = len(twin.observe(0.0, np.zeros(twin.n)))
    ends = {
        None: None,
        "time": lambda t, x: t > 6.5 * c.dt,
        "state": lambda t, x: jnp.abs(x[0]) > 0.9,
    }[c.ends]
    env = dlx.Environment(
        plant,
        dlx.costs.Quadratic(np.eye(twin.n), 0.5 * np.eye(1), final=2 * np.eye(twin.n)),
        disturbance=disturbance,
        sensor_noise=dlx.disturbances.Gaussian(c.noise, size=p) if c.noise else None,
        control_bounds=None if c.bound is None else (-c.bound, c.bound),
        terminated=ends,
        horizon=HORIZON,
    )
    K = 0.5 * rng.normal(size=(1, p))
    return env, Feedback(K), twin, known, 0.5 * rng.normal(size=twin.n)


def loop(c: Composition, K: Any, twin: Twin, x0: Any, w: Any, noise: Any) -> dict:
    """The closed loop in NumPy."""
    x, last, done, length, total = x0, np.zeros(1), False, HORIZON, 0.0
    kept: dict[str, list] = {
        name: []
        for name in ("states", "observations", "controls", "costs", "terminated")
    }
    clipped = []
    for k in range(HORIZON):
        t = k * c.dt
        y = twin.observe(t, x) + noise[k]
        asked = -K @ y + 0.3 * last + 0.1 * k
        u = asked if c.bound is None else np.clip(asked, -c.bound, c.bound)
        cost = x @ x + 0.5 * u @ u
        x_next = twin.advance(t, x, u, w[k])
        if done:
            u, cost, x_next = np.zeros(1), 0.0, x
        clipped.append(not done and bool(np.any(u != asked)))
        for name, value in zip(kept, (x, y, u, cost), strict=False):
            kept[name].append(value)
        total += cost
        if not done:
            last = u
            ended = {
                None: False,
                "time": t + c.dt > 6.5 * c.dt,
                "state": abs(x_next[0]) > 0.9,
            }[c.ends]
            if ended:
                done, length = True, k + 1
        kept["terminated"].append(done)
        x = x_next
    final = 2 * x @ x
    return {name: np.array(value) for name, value in kept.items()} | dict(
        final_state=x,
        final_cost=final,
        total_cost=total + final,
        length=length,
        ended=done,
        clipped=np.array(clipped),
    )


def near_an_edge(c: Composition, expected: dict) -> bool:
    """Whether rounding may decide a bound or the end of the episode."""
    edges = np.abs(np.abs(expected["states"][:, 0]) - 0.9)
    return c.ends == "state" and edges.min() < 1e-3


def check(c: Composition) -> None:
    env, controller, twin, known, x0 = build(c)
    single = c.single or not jax.config.jax_enable_x64
    dtype = np.float32 if single else np.float64
    x0 = x0.astype(dtype)
    key = jr.key(c.seed)
    run = dlx.rollout(env, controller, key=key, x0=jnp.asarray(x0))
    assert run.states.dtype == dtype
    index = np.arange(HORIZON)
    w = np.asarray(run.disturbances, np.float64)
    close = dict(rtol=2e-4, atol=2e-4) if single else dict(rtol=1e-7, atol=1e-7)
    if known is not None:
        assert_close(w, known(index), atol=1e-5 if single else 1e-12)
    noise = np.zeros((HORIZON, 1))
    if env.sensor_noise is not None:
        times = jnp.arange(HORIZON, dtype=dtype) * c.dt
        noise_key = jr.split(key, 4)[2]
        noise = np.asarray(env.sensor_noise.sequence(noise_key, times), np.float64)
    K = np.asarray(controller.K, np.float64)
    expected = loop(c, K, twin, x0.astype(np.float64), w, noise)
    if near_an_edge(c, expected):
        return
    clipped = expected.pop("clipped")
    for name, value in expected.items():
        actual = np.asarray(getattr(run, name))
        if name == "states":
            actual = actual[:-1]
        np.testing.assert_allclose(actual, value, err_msg=name, **close)
    if c.bound is None:
        assert run.incidents == {}
    else:
        # A control within rounding of a bound may go either way.
        wrong = np.asarray(run.incidents["clipped_control"]) != clipped
        at = np.abs(np.abs(expected["controls"][:, 0]) - c.bound) < 1e-4
        assert not np.any(wrong & ~at)
        count = int(np.sum(np.asarray(run.incidents["clipped_control"])))
        assert run.incident_counts["clipped_control"] == count
    check_start_time(c, env.dynamics, twin, x0, close)


def check_start_time(c: Composition, plant: Any, twin: Twin, x0: Any, close) -> None:
    """The same dynamics from a later time, under controls and disturbances given."""
    rng = np.random.default_rng(c.seed + 1)
    first, steps = int(rng.integers(0, 20)), 5
    u = (0.3 * rng.normal(size=(steps, 1))).astype(x0.dtype)
    w = (0.1 * rng.normal(size=(steps, twin.k))).astype(x0.dtype)
    states = dlx.open_loop(plant, x0, u, w, t0=first * c.dt)
    x = x0.astype(np.float64)
    for k in range(steps):
        x = twin.advance((first + k) * c.dt, x, u[k].astype(float), w[k].astype(float))
        np.testing.assert_allclose(states[k + 1], x, err_msg="later", **close)


quietly = dict(
    deadline=None,
    # Each example compiles, so that to shrink one takes minutes.
    phases=(Phase.explicit, Phase.reuse, Phase.generate),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


@settings(max_examples=2, **quietly)
@given(compositions)
def test_a_random_loop(c):
    check(c)


@minutes("250 random loops, each of which compiles a program of its own")
@settings(max_examples=250, **quietly)
@given(compositions)
def test_many_random_loops(c):
    check(c)


# Derivatives and variances behind every wrapper.

STACKS = [(), ("weak", "delayed", "attacked")]  # none, and all


@needs_x64
@pytest.mark.parametrize(
    "kind, wrappers",
    [
        *(pytest.param("field", stack, id="+".join(stack)) for stack in STACKS),
        pytest.param("brownian", (), id="brownian"),
        pytest.param("brownian", STACKS[-1], id="brownian, all"),
    ],
)
def test_derivatives_behind_a_wrapper(kind, wrappers):
    c = Composition(
        kind, "RK4", 2, 0.05, True, wrappers, "gaussian", 0.1, None, None, False, 3
    )
    env, controller, twin, _, x0 = build(c)

    @jax.jit
    @functools.partial(jax.grad, argnums=(0, 1), has_aux=True)
    def slopes(x0, K):
        there = eqx.tree_at(lambda c: c.K, controller, K)
        run = dlx.rollout(env, there, key=jr.key(0), x0=x0)
        return run.total_cost, run.disturbances

    (by_x0, by_K), w = slopes(x0, controller.K)
    w = np.asarray(w)
    times = jnp.arange(HORIZON) * c.dt
    noise = np.asarray(env.sensor_noise.sequence(jr.split(jr.key(0), 4)[2], times))
    K = np.asarray(controller.K)

    def total(x0, K):
        return loop(c, K, twin, x0, w, noise)["total_cost"]

    for here, slope, at in (
        (x0, by_x0, lambda z: total(z, K)),
        (K, by_K, lambda z: total(x0, z)),
    ):
        for i in np.ndindex(here.shape):
            e = np.zeros(here.shape)
            e[i] = 1e-5
            difference = (at(here + e) - at(here - e)) / 2e-5
            assert_close(slope[i], difference, rtol=1e-8, atol=1e-8)


@once
@pytest.mark.parametrize("wrappers", STACKS, ids="+".join)
def test_variance_behind_a_wrapper(wrappers):
    """Of Brownian motion over the horizon, whatever is around the plant."""

    class Motion(dlx.AbstractSystem):
        state_names, control_names = ("x",), ("u",)

        def vector_field(self, t, x, u, w):
            return 0.0 * x

        def diffusion(self, t, x, u):
            return jnp.full(1, 2.0)

        def equilibrium(self):
            return jnp.zeros(1), jnp.zeros(1)

    plant = dlx.Discretized(Motion(), dt=0.1, substeps=3)
    rng = np.random.default_rng(0)
    twin = Twin(lambda *args: args[1], lambda t, x: x, 1, 3)
    for name in wrappers:
        if name == "attacked":  # by nobody
            L = np.zeros((plant.disturbance_size, plant.state_size))
            plant = dlx.dynamics.WorstCase(plant, L)
        else:
            plant, twin = WRAPPERS[name](plant, twin, rng)
    env = dlx.Environment(plant, dlx.costs.Quadratic(np.eye(plant.state_size), [1.0]))
    assert env.disturbance.size == 3

    def last(key):
        zero = dlx.controllers.Zero(1)
        return dlx.rollout(env, zero, key=key, horizon=5).states[-1, 0]

    ends = np.asarray(jax.vmap(last)(jr.split(jr.key(0), 4000)))
    expected = 2.0**2 * 5 * 0.1
    assert abs(np.var(ends) / expected - 1) < 4 * np.sqrt(2 / 4000)


@once
def test_a_wrapper_forwards_every_property():
    """Those that the base classes declare and do not derive from others."""
    derived = {"state_size", "control_size", "observation_size", "advance"}
    # Which go with `advance`.
    derived |= {"advance_with_events", "describe_fault"}
    derived |= {"declares_noise"}  # which it does by its `noise`
    bases = dlx.AbstractDynamics, dlx.systems.AbstractPlant
    declared = {
        name
        for base in bases
        for name in vars(base)
        if not name.startswith("_") and name not in derived
    } | {"dt", "state_names", "control_names"}
    own = [k for k in dlx.dynamics.AbstractWrapper.__mro__ if k not in bases]
    assert declared <= {name for kind in own for name in vars(kind)}


@once
def test_a_wrapper_that_observes_otherwise_says_so():
    class Half(dlx.dynamics.AbstractWrapper):
        dynamics: dlx.AbstractDynamics

        def advance(self, t, x, u, w):
            return self.dynamics.advance(t, x, u, w)

        def observe(self, t, x):
            return x / 2

    A, B = np.eye(2) / 2, np.ones((2, 1))
    observed = dlx.LinearDynamics(A, B, np.eye(2))
    assert observed.observes_state and Weak(observed).observes_state
    assert not Half(observed).observes_state
    assert not Weak(dlx.LinearDynamics(A, B, 2 * np.eye(2))).observes_state
    assert not dlx.dynamics.Delayed(observed, sensor=1).observes_state


@once
def test_a_learner_takes_a_wrapped_plant_that_observes_its_state(key):
    A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])
    plant = dlx.LinearDynamics(A, B, np.eye(2))
    game = dlx.dynamics.WorstCase(plant, 0.01 * np.eye(2))
    base = dlx.controllers.LQR(plant, np.eye(2), np.eye(1))
    cost = dlx.costs.Quadratic(np.eye(2), np.eye(1))
    learner = dlx.controllers.gpc(game, cost, base=base)
    env = dlx.Environment(game, cost)
    run = lambda: dlx.rollout(env, learner, key=key, horizon=20).total_cost
    assert jax.eval_shape(run).shape == ()


class ByHand(dlx.AbstractDynamics):
    dynamics: dlx.AbstractDynamics
    dt = property(lambda self: self.dynamics.dt)
    state_names = property(lambda self: self.dynamics.state_names)
    control_names = property(lambda self: self.dynamics.control_names)
    disturbance_size = property(lambda self: self.dynamics.disturbance_size)

    def advance(self, t, x, u, w):
        return self.dynamics.advance(t, x, u, w)


@once
def test_noise_that_a_hand_made_wrapper_would_lose_is_an_error():
    class Says(ByHand):
        noise = property(lambda self: self.dynamics.noise)
        increments = 0

    class Forwards(ByHand):
        noise = property(lambda self: self.dynamics.noise)
        increments = property(lambda self: self.dynamics.increments)

    class Quiet(ByHand):
        noise = None

    class Euler(ByHand):
        dynamics: dict[str, list[Shaky]]
        dt = 0.1
        state_names = control_names = ("x",)
        disturbance_size = 1

    noisy = dlx.Discretized(Shaky(), dt=0.1, substeps=2)
    calm = dlx.Discretized(Spring(), dt=0.1)
    cost = dlx.costs.Quadratic(np.eye(2), np.eye(1))
    make = lambda dynamics: dlx.Environment(dynamics, cost)
    with user_error(match="increments of Says must be at least 1.*AbstractWrapper"):
        make(Says(noisy))
    hidden = "Environment: ByHand must forward `noise` of the {} that it.*"
    hidden += "AbstractWrapper, or define `noise` in ByHand"
    with user_error(match=hidden.format("Discretized")):
        make(ByHand(noisy))
    with user_error(match=hidden.format("Delayed")):
        make(ByHand(dlx.dynamics.Delayed(noisy)))
    with user_error(match=hidden.format("Discretized")):
        make(Weak(Forwards(ByHand(noisy))))
    with user_error(match="Euler must forward `noise` of the Shaky"):
        make(Euler({"system": [Shaky()]}))
    with user_error(match=hidden.format("Discretized")):
        dlx.replace(make(calm), {"dynamics": ByHand(noisy)})
    for legal in (ByHand(calm), Quiet(noisy), ByHand(Quiet(noisy)), Weak(Quiet(noisy))):
        assert isinstance(make(legal).disturbance, dlx.disturbances.Zero)
    for legal in (Forwards(noisy), Weak(Forwards(noisy))):
        assert isinstance(make(legal).disturbance, dlx.disturbances.Brownian)
    batch = jax.vmap(lambda dt: make(Forwards(dlx.Discretized(Shaky(), dt))))
    assert batch(jnp.full(3, 0.1)).dt.shape == (3,)


@once
def test_a_delay_of_nothing_observes_the_state():
    plant = dlx.Discretized(Spring(), dt=0.1)
    assert dlx.dynamics.Delayed(plant).observes_state
    assert not dlx.dynamics.Delayed(plant, controls=1).observes_state
