"""What several test files share."""

import contextlib
import os
import shutil

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import delucax as dlx
from delucax._module import path_string


needs_x64 = pytest.mark.skipif(not jax.config.jax_enable_x64, reason="float64 only")
needs_x32 = pytest.mark.skipif(bool(jax.config.jax_enable_x64), reason="float32 only")
minutes = pytest.mark.minutes
once = pytest.mark.skipif(
    bool(jax.config.jax_enable_x64), reason="precision plays no part: float32 will do"
)

has_compiler = any(map(shutil.which, (os.environ.get("CC") or "cc", "gcc", "clang")))
needs_compiler = pytest.mark.skipif(not has_compiler, reason="no C compiler is there")


def dtype():
    """The precision of this run."""
    return jnp.zeros(()).dtype


def tolerance(single, double):
    return double if jax.config.jax_enable_x64 else single


def assert_close(a, b, *, rtol=0.0, atol=0.0):
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=rtol, atol=atol)


def central_difference(f, x, step=1e-6):
    """The gradient of a scalar `f` at an array `x`, by central differences."""
    x = np.asarray(x, np.float64)
    gradient = np.zeros_like(x)
    for i in np.ndindex(x.shape):
        h = step * max(1.0, abs(x[i]))
        up, down = x.copy(), x.copy()
        up[i] += h
        down[i] -= h
        gradient[i] = (float(f(jnp.asarray(up))) - float(f(jnp.asarray(down)))) / (
            2 * h
        )
    return gradient


def assert_gradient(f, x, step=1e-6, **close):
    """The gradient of a scalar `f` at an array is its central difference. One program
    has both."""
    both, x = jax.jit(jax.value_and_grad(f)), np.asarray(x, np.float64)
    expected = central_difference(lambda x: both(x)[0], x, step)
    gradient = both(x)[1]
    assert_close(gradient, expected, **close)
    return gradient


def in_both_modes(f):
    """A function of a vector, and its Jacobian forwards and backwards."""

    def derivatives(x):
        values, push = jax.linearize(f, x)
        pull = jax.linear_transpose(push, x)
        forwards = jax.vmap(push, out_axes=1)(jnp.eye(len(x)))
        (backwards,) = jax.vmap(pull)(jnp.eye(len(values)))
        return values, forwards, backwards

    return derivatives


def check_first_order(line, step=1e-5):
    """The derivative of `line`, a number of a number, in reverse mode, is its central
    difference. Returns the compiled value at 0.1."""
    both = jax.jit(jax.value_and_grad(line))
    (low, _), (value, slope), (high, _) = (both(0.1 + h) for h in (-step, 0.0, step))
    assert_close(slope, (high - low) / (2 * step), rtol=1e-6)
    return value


def check_second_order(line, backwards=False, step=1e-5):
    """The derivatives of `line`, a number of a number, in both modes, and the second
    one, forwards and if asked for backwards, are central differences. Returns the
    compiled value at 0.1."""

    @jax.jit
    def derivatives(e):
        both = jax.value_and_grad(line)
        (value, reverse), (forward, second) = jax.jvp(both, (e,), (1.0,))
        seconds = [second, jax.grad(jax.grad(line))(e)] if backwards else [second]
        return value, reverse, forward, jnp.stack(seconds)

    (low, slope_low, *_), (high, slope_high, *_) = (
        derivatives(0.1 + h) for h in (-step, step)
    )
    value, reverse, forward, seconds = derivatives(0.1)
    slope, second = (high - low) / (2 * step), (slope_high - slope_low) / (2 * step)
    assert_close(jnp.stack([reverse, forward]), np.full(2, slope), rtol=1e-6)
    assert_close(seconds, np.full(len(seconds), second), rtol=1e-6)
    return value


@contextlib.contextmanager
def as_a_user():
    """Without the type checks that only the tests switch on, so that our own errors
    are the ones that are seen."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


@contextlib.contextmanager
def user_error(kind=ValueError, match=None):
    """A user meets this error."""
    with as_a_user(), pytest.raises(kind, match=match):
        yield


def assert_refuses_nan(module):
    """Every number of `module` can be replaced by itself, and by NaN nowhere."""
    for path, leaf in jax.tree_util.tree_flatten_with_path(module)[0]:
        path = path_string(path)
        if not eqx.is_inexact_array(leaf):
            continue
        assert_same(dlx.replace(module, {path: leaf}), module)
        with pytest.raises(ValueError):
            dlx.replace(module, {path: np.full_like(leaf, np.nan)})


def assert_same(one, other):
    """As `eqx.tree_equal`; numbers are compared by NumPy, which compiles nothing."""
    pairs = [eqx.partition(module, eqx.is_inexact_array) for module in (one, other)]
    (numbers, rest), (others, other_rest) = pairs
    assert eqx.tree_equal(rest, other_rest)
    assert jax.tree.structure(numbers) == jax.tree.structure(others)
    for a, b in zip(jax.tree.leaves(numbers), jax.tree.leaves(others), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def ilqr(
    dynamics, cost, x0, controls, t0=0.0, w=None, bounds=None, *, throw=True, **options
):
    """A plan by `ILQR` with options; constraints and difference are of the problem."""
    names = "constraints", "difference", "fallback"
    rest = {name: options.pop(name) for name in names if name in options}
    given = dynamics, cost, x0, controls, t0, w, bounds
    return dlx.planning.ILQR(**options)(*given, throw=throw, **rest)


def original_ilqr(dynamics, cost, x0, controls, *, iterations):
    """Iterative LQR with the line search of the original library, which is learning of
    a plant that the model knows: its steps may grow, and nothing is regularised."""
    shape = eqx.filter_eval_shape(dlx.planning.ilqr, dynamics, cost, x0, controls)
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
    given = dlx.open_loop(dynamics, x0, controls), controls
    start = eqx.tree_at(lambda p: (p.states, p.controls), blank, given)
    learn = dlx.planning.ilc
    return learn(dynamics, dynamics, cost, start, iterations=iterations, throw=False)


def trajectory_of(env, states, controls=None):
    """A trajectory with these states; no simulation."""
    steps = len(states) - 1
    if controls is None:
        controls = np.zeros((steps, env.control_size))
    zero = jnp.zeros(())
    return dlx.Trajectory(
        states=jnp.asarray(states),
        controls=jnp.asarray(controls),
        costs=jnp.zeros(steps),
        final_state=jnp.asarray(states[-1]),
        final_cost=zero,
        total_cost=zero,
        length=jnp.asarray(steps),
        ended=jnp.zeros((), bool),
        result=dlx.RESULTS.successful,
        dt=env.dt,
        recorded_times=None,
        recorded_observations=None,
        recorded_disturbances=None,
        recorded_terminated=None,
        steps=steps,
        keep=("states", "controls", "costs"),
        disturbance_size=env.disturbance_size,
        state_names=tuple(env.dynamics.state_names),
        control_names=tuple(env.dynamics.control_names),
        state_units=tuple(env.dynamics.state_units),
        control_units=tuple(env.dynamics.control_units),
        time_unit=env.dynamics.time_unit,
    )


@contextlib.contextmanager
def counted_programs():
    """The events of compilation within."""
    events = []

    def listen(event, duration_secs, **others):
        del duration_secs
        if event == "/jax/core/compile/backend_compile_duration":
            events.append(others)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield events
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def pages_of(root):
    """README and the pages of the documentation, without the reference and the
    notebooks."""
    docs = root / "docs"
    pages = [page.relative_to(docs) for page in docs.rglob("*.md")]
    own = [page for page in pages if page.parts[0] not in ("api", "notebooks")]
    return sorted([root / "README.md", *(docs / page for page in own)])


def name_of(root, page):
    """The name of a page, with that of its folder in `docs`."""
    docs = root / "docs"
    return str(page.relative_to(docs if docs in page.parents else root))


class CountCalls:
    """Counts how often it is traced, when it is called inside a compiled function."""

    def __init__(self):
        self.count = 0

    def __call__(self):
        self.count += 1


class Drift(dlx.AbstractSystem):
    """With a diffusion, so that noise is the default."""

    state_names = ("x",)
    control_names = ("u",)

    def vector_field(self, t, x, u, w):
        return u - x

    def diffusion(self, t, x, u):
        return jnp.ones(1)
