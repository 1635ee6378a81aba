"""Every controller of the catalogue in C: in closed loop as in JAX."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c_programs import exported, load
from contracts.test_controllers import A, B, CASES
from helpers import needs_compiler, tolerance

import delucax as dlx
from delucax import export


# A declared answer is a warning; they are expected where they are tested.
pytestmark = [needs_compiler, pytest.mark.filterwarnings("ignore:.*is not finite")]
STEPS = 50
KEY = jax.random.key(3)
ONES = np.ones(2)


def file_name(label):
    return "".join(c if c.isalnum() else "_" for c in label).lower()


def in_jax(controller):
    """The observations and controls of a closed loop, with disturbances."""
    w = jnp.asarray(np.random.default_rng(0).normal(0, 0.05, (STEPS, 2)))
    state, static = eqx.partition(controller.init(key=KEY), eqx.is_array)

    def step(carry, inputs):
        x, arrays = carry
        k, w = inputs
        u, after = controller(0.1 * k, x, eqx.combine(arrays, static))
        after = controller.applied(u, 0.1 * k, after)
        return (A @ x + B @ u + w, eqx.filter(after, eqx.is_array)), (x, u)

    start = jnp.array([0.5, -0.3]), state
    run = jax.jit(lambda: jax.lax.scan(step, start, (jnp.arange(STEPS), w))[1])
    return map(np.asarray, run())


# In parts, so that several processes share them.
@pytest.mark.parametrize("part", range(4))
def test_every_controller(tmp_path, part):
    # The same code writes both precisions, and some of the cases show their digits.
    x64 = jax.config.jax_enable_x64  # pyright: ignore
    for label in list(CASES)[part :: 4 if x64 else 32]:
        case = CASES[label]
        controller, name = case.make(1.0), file_name(label)
        export.c(controller, tmp_path, name=name, example=ONES, key=KEY)
        program = load(tmp_path, name).running()
        for k, (y, expected) in enumerate(zip(*in_jax(controller), strict=True)):
            u = program.step(0.1 * k, y)
            if np.all(np.isfinite(expected)):
                assert program.flag == 0, label
                scale = np.maximum(1, np.abs(expected))
                off = np.max(np.abs(u - expected) / scale)
                assert off < tolerance(1e-3, 1e-11), (label, k, u, expected)
            else:
                assert program.flag, label
            program.applied(u, 0.1 * k)


def law(**options):
    return dlx.controllers.PID([1.0], 2.0, 0.3, dt=0.1, output=0, **options)


@pytest.mark.parametrize("fallback", [None, [0.25]])
def test_answer_to_bad_numbers(tmp_path, fallback):
    options = dict(name="pid", example=np.zeros(2), dtype="float64", fallback=fallback)
    export.c(law(), tmp_path, **options)
    controller = load(tmp_path, "pid")
    program, state = controller.running(), controller.init()
    bad = np.array([np.nan, 0.0])
    assert program.step(0.0, bad) == (0.0 if fallback is None else 0.25)
    assert program.flag == 1
    first = np.array([0.5, 0.0])
    good = program.step(0.0, first)
    assert program.flag == 0
    _, state = controller(0.0, first, state)
    for bad in ([np.inf, 0.0], [1e308, 0.0]):
        u, after = controller(0.0, np.array(bad), state)
        assert u == (good if fallback is None else 0.25)
        np.testing.assert_array_equal(after.memory, state.memory)
        np.testing.assert_array_equal(program.step(0.0, bad), u)
        assert program.flag == (1 if np.isinf(bad[0]) else 2)


class Late(dlx.AbstractController):
    """The control is the observation of the step before."""

    size: int

    def init(self, *, key=None):
        return jnp.zeros(self.size)

    def __call__(self, t, y, state):
        return state, y


@pytest.mark.parametrize("size", [2, 10])
def test_a_control_that_is_the_old_state(tmp_path, size):
    export.c(Late(size), tmp_path, name="late", example=np.zeros(size))
    program = load(tmp_path, "late").running()
    for k in range(3):
        np.testing.assert_array_equal(program.step(0.0, np.full(size, k + 1.0)), k)
    np.testing.assert_array_equal(program.step(0.0, np.full(size, np.nan)), 2)
    assert program.flag == 1


def counted(x):
    """Errors on whole numbers and booleans, one in a loop, of which no NaN is left."""
    k = eqx.error_if(jnp.array(3), x[0] > 1, "It is too large.")
    flag = eqx.error_if(x[1] > 0, x[1] > 2, "It is too large.")
    body = lambda i, n: eqx.error_if(n + i, n + x[2] > 9, "It is too many.")
    return k, flag, jax.lax.fori_loop(0, 4, body, 1)


class Counting(dlx.AbstractController):
    """An error on a number that its state counts."""

    def init(self, *, key=None):
        return jnp.array(0)

    def __call__(self, t, y, state):
        return y[:1], eqx.error_if(state + 1, y[1] > 1, "It is too large.")


def test_errors_without_nan_set_the_flag(tmp_path):
    function = exported(tmp_path, {"counted": (counted, (np.zeros(3),))})["counted"]
    for x, flag in (([0, 0, 0], 0), ([2, 0, 0], 2), ([0, 3, 0], 2), ([0, 0, 7], 2)):
        assert function(np.array(x, float))[0] == flag
    export.c(Counting(), tmp_path, name="counting", example=ONES)
    controller = load(tmp_path, "counting")
    state, counts = controller.init(), []
    kind = controller.description.state[0].dtype
    for y in (0.0, 2.0, 0.0):
        _, state = controller(0.0, np.array([0.0, y]), state)
        counts.append(int(state.memory.view(kind)[0]))
    assert counts == [1, 1, 2]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_precision_is_not_that_of_the_process(tmp_path, dtype):
    export.c(law(), tmp_path, name="pid", example=np.zeros(2), dtype=dtype)
    program = load(tmp_path, "pid").running()
    third = np.dtype(dtype).type(1) / 3
    u = program.step(0.0, [third, 0.0])
    assert u.dtype == dtype
    # The proportional, integral and derivative part of the error of the first step.
    expected, _ = law()(0.0, jnp.array([third, 0.0]), law().init())
    np.testing.assert_allclose(u, expected, rtol=1e-6)


class Tossing(dlx.AbstractController):
    """Draws from a key that it folds its steps into, and keeps a batch of keys."""

    kind: str = "threefry2x32"

    def init(self, *, key=None):
        if key is None:
            raise ValueError("Tossing.init: key must be one random key.")
        return jax.random.split(jax.random.key(5, impl=self.kind), 3), jnp.array(0)

    def __call__(self, t, y, state):
        keys, k = state
        _, now = jax.vmap(jax.random.split, out_axes=1)(keys)
        now = jax.random.fold_in(jnp.where(y[0] > 0, now[1], now[k % 3]), k)
        one, two, three = jax.random.split(now, 3)
        u = jax.random.uniform(one, (2, 9)).sum(0)[:2]
        toss = jax.random.bernoulli(two), jax.random.randint(three, (), -3, 9)
        order = jax.random.permutation(two, jnp.arange(5))
        u = jnp.concatenate([u, jnp.stack([*toss, order[0]]).astype(u.dtype)])
        return u, (jnp.roll(keys, 1), k + 1)


def test_draws_are_those_of_jax(tmp_path):
    """Bit by bit, where the arithmetic that follows is exact."""
    controller = Tossing()
    export.c(controller, tmp_path, name="tossing", example=ONES, key=KEY)
    loaded, state = export.load(tmp_path), controller.init(key=KEY)
    mine = loaded.init()
    for k in range(9):
        y = np.array([(-1.0) ** k, 0.0])
        expected, state = controller(0.0, jnp.asarray(y), state)
        u, mine = loaded(0.0, y, mine)
        np.testing.assert_array_equal(u, expected)


def test_draws_without_a_key_or_of_another_generator(tmp_path):
    for given, words in (
        (Tossing(), "Tossing cannot be exported without key=.*key must be one"),
        (Tossing("rbg"), "Tossing cannot be exported: it draws with a key<rbg>"),
    ):
        key = None if given.kind == "threefry2x32" else KEY
        with pytest.raises(ValueError, match=words):
            export.c(given, tmp_path, name="tossing", example=ONES, key=key)
    assert not any(tmp_path.iterdir())


class Returning(dlx.AbstractController):
    """Returns these."""

    control: tuple = (1.0,)
    start: Any = None
    after: Any = None

    def init(self, *, key=None):
        return jax.tree.map(jnp.asarray, self.start)

    def __call__(self, t, y, state):
        return jnp.array(self.control), jax.tree.map(jnp.asarray, self.after)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (dict(control=1.0), r"a control of shape \(m,\), got shape \(\)"),
        (dict(control=()), r"a control of shape \(m,\), got shape \(0,\)"),
        (dict(after=1.0), "a state like that of init"),
        (dict(start=1, after=1.5), "a state like that of init"),
        (dict(start=[1.0], after=[[1.0, 2.0]]), "a state like that of init"),
        (dict(start=np.ones(1), after=np.ones(2)), r"init, f..\[1\], got f..\[2\]"),
    ],
)
def test_wrong_controllers(tmp_path, given, words):
    with pytest.raises(ValueError, match=words):
        export.c(Returning(**given), tmp_path, name="law", example=ONES)
    assert not any(tmp_path.iterdir())


class Unusual(dlx.AbstractController):
    """A state of many kinds, with names that C uses itself."""

    gain: Any = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float16))

    def init(self, *, key=None):
        names = "y u t state last_control v1 INFINITY NULL sin sinf int32_t unix a_b"
        rest = {name: jnp.zeros(1) for name in [*names.split(), "a b", "*/", "é"]}
        parts = [jnp.zeros(2), None, "word", 3, (jnp.array(1, jnp.int16),)]
        more = {"empty": np.zeros((0, 3)), "flags": jnp.array([True, False])}
        return {"rest": rest, "parts": parts, "one": 2.0, "call": abs, **more}

    def __call__(self, t, y, state):
        x, *_, k, (count,) = state["parts"]
        rest = {name: 0.5 * x + y[:1] for name, x in state["rest"].items()}
        u = self.gain * x[:1] + k + state["one"] + sum(rest.values()) + count
        parts = [x + y, None, "word", 3, (count * 3,)]
        u = jnp.where(state["flags"][0], u, -u)
        return u, state | {"rest": rest, "parts": parts, "flags": ~state["flags"]}


def test_unusual_states(tmp_path):
    controller, y = Unusual(0.3), np.array([0.2, -0.1])
    export.c(controller, tmp_path, name="unusual", example=ONES)
    loaded, state = load(tmp_path, "unusual"), controller.init()
    mine = loaded.init()
    for k in range(12):
        expected, state = controller(0.1 * k, jnp.asarray(y), state)
        u, mine = loaded(0.1 * k, y, mine)
        np.testing.assert_allclose(u, expected, rtol=tolerance(1e-5, 1e-12))


@needs_compiler
def test_a_plant_with_events(tmp_path):
    dynamics = dlx.Discretized(dlx.systems.BouncingBall(), dt=0.1)
    export.c(dynamics, tmp_path, name="ball")
    step, x = export.load(tmp_path), np.array([1.0, 0.0], jnp.zeros(()).dtype)
    states = [x]
    for _ in range(20):
        states.append(step(0.0, states[-1], np.zeros(1)))
    expected = dlx.open_loop(dynamics, x, jnp.zeros((20, 1)))
    np.testing.assert_allclose(states, expected, atol=tolerance(1e-5, 1e-12))


def test_a_linear_plant_with_a_matrix_of_its_disturbance(tmp_path):
    plant = dlx.LinearDynamics(A, B, E=[[1.0], [0.5]])
    export.c(plant, tmp_path, name="plant")
    x, u, w = np.ones(2), np.full(1, 2.0), np.full(1, 3.0)
    expected = A @ x + B @ u + [3.0, 1.5]
    np.testing.assert_allclose(export.load(tmp_path)(0.0, x, u, w), expected, rtol=1e-6)


def test_a_corrected_regulator_keeps_its_cost(tmp_path):
    env = dlx.make("pendulum", horizon=50)
    scaled = dlx.controllers.Standardise(jnp.full(3, 0.1), jnp.full(3, 2.0), env.encode)
    how: Any = dict(features=scaled, bounds=(-1.0, 1.0), key=KEY)
    network = dlx.controllers.MLP(3, 1, 8, 1, **how)
    lqr = dlx.controllers.local_lqr(env)
    policy = dlx.controllers.Residual(lqr, network, env.control_bounds)
    export.c(policy, tmp_path, name="both", example=ONES)
    in_c = export.load(tmp_path)
    starts = jnp.array([[0.2, 0.1], [-0.3, 0.5]])
    run = lambda law, x0: dlx.rollout(env, law, x0=x0, key=KEY, keep=()).total_cost
    for x0 in starts:
        np.testing.assert_allclose(run(in_c, x0), run(policy, x0), rtol=1e-5)
