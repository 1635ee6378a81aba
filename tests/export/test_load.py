"""Exported C, compiled and called from Python."""

import copy
import os
import shutil

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, dtype, needs_compiler, once, tolerance, user_error

import delucax as dlx
from delucax import export


pytestmark = needs_compiler
TIGHT = {"rtol": tolerance(1e-5, 1e-12), "atol": tolerance(1e-5, 1e-12)}
DT = 0.05


class Counting(dlx.AbstractController):
    """A gain that falls with what was applied and what it cost."""

    def init(self, *, key=None):
        return {"steps": jnp.zeros((), jnp.int32), "spent": jnp.zeros(())}

    def __call__(self, t, y, state):
        steps = state["steps"] + 1
        u = -(20 * y[:1] + 5 * y[1:]) / (1 + state["spent"]) + 0.01 * jnp.sin(t)
        return u, state | {"steps": steps}

    def applied(self, u, cost, state):
        spent = state["spent"] + 1e-3 * (cost + u[0] ** 2 + state["steps"])
        return state | {"spent": spent}


def rotate(x, k):
    """A function of two arrays with two results."""
    return jnp.roll(x, 1) * k, jnp.sum(x**2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A controller and a function."""
    made = tmp_path_factory.mktemp("exported")
    export.c(Counting(), made, name="counting", example=jnp.zeros(2))
    example = jnp.zeros(3), jnp.zeros((), jnp.int32)
    export.c(rotate, made, name="rotate", example=example)
    return made


@pytest.fixture(scope="module")
def controller(folder):
    return export.load(folder, name="counting")


@pytest.fixture(scope="module")
def function(folder):
    return export.load(folder, name="rotate")


@pytest.fixture
def pendulum():
    return dlx.make("pendulum", horizon=20)


def test_a_rollout(controller, pendulum, key):
    """Under `jit`, and as a batch, it does what was exported does."""
    x0 = jnp.array([[0.1, 0.0], [-0.2, 0.3]])
    run = jax.vmap(
        lambda law, x0: dlx.rollout(pendulum, law, key=key, x0=x0), (None, 0)
    )
    found, expected = run(controller, x0), run(Counting(), x0)
    assert_close(found.controls, expected.controls, **TIGHT)
    assert found.controls.dtype == dtype()
    assert not np.any(found.incidents["declared_answer"])


def test_arrays_of_numpy(controller):
    """They go in and come out, and what goes in stays as it is."""
    y, expected = np.array([0.1, -0.2]), Counting()
    state, theirs = controller.init(), expected.init()
    running = controller.running()
    before = state.memory.copy()
    for k in range(3):
        u, after = controller(k * DT, y, state)
        u_running = running.step(k * DT, y)
        assert type(u) is np.ndarray and type(after.memory) is np.ndarray
        wanted, theirs = expected(k * DT, jnp.asarray(y), theirs)
        assert_close(u, wanted, **TIGHT)
        assert_close(u_running, wanted, **TIGHT)
        assert np.array_equal(state.memory, before)
        state = controller.applied(u, 0.3, after)
        running.applied(u_running, 0.3)
        theirs = expected.applied(wanted, jnp.asarray(0.3), theirs)
        before = state.memory.copy()
    first = running.step(0.0, y)
    running.reset()
    assert not np.array_equal(running.step(0.0, y), first)


def test_the_declared_answer_is_seen(controller, pendulum, key):
    """By a rollout as an incident, by what runs as a warning and a flag."""

    class Blinded(dlx.AbstractController):
        base: dlx.AbstractController

        def init(self, *, key=None):
            return self.base.init(key=key)

        def __call__(self, t, y, state):
            return self.base(t, jnp.where(jnp.round(t / DT) == 3, jnp.nan, y), state)

    run = dlx.rollout(pendulum, Blinded(controller), key=key, x0=[0.1, 0.0])
    assert np.flatnonzero(run.incidents["declared_answer"]).tolist() == [3]
    assert np.all(np.isfinite(run.controls))
    _, state = controller(0.0, np.array([np.nan, 0.0]), controller.init())
    assert int(state.declared.count) == 1
    running = controller.running()
    with pytest.warns(RuntimeWarning, match="counting: .*not finite"):
        assert np.all(np.isfinite(running.step(0.0, [np.nan, 0.0])))
    assert running.flag
    running.step(0.0, [0.1, 0.0])
    assert not running.flag


def test_a_function(function):
    x, k = np.arange(3.0), 2
    expected = rotate(x, k)
    for found in (function(x, k), jax.jit(function)(jnp.asarray(x), k)):
        for one, other in zip(found, expected, strict=True):
            assert_close(one, other, **TIGHT)
    assert all(type(result) is np.ndarray for result in function(x, k))
    many = jnp.stack([x, 2 * x])
    turned, squares = jax.vmap(function, (0, None))(many, k)
    assert_close(turned, jax.vmap(lambda x: rotate(x, k)[0])(many), **TIGHT)
    assert squares.shape == (2,)
    assert_close(copy.deepcopy(function)(x, k)[1], expected[1], **TIGHT)


def test_memory_of_ones_own(function):
    """A bound function reads and writes the arrays that it was given."""
    x, k = np.arange(3, dtype=dtype()), np.array(2, np.int32)
    turned, square = np.zeros(3, dtype()), np.zeros((), dtype())
    step = function.bind(x, k, turned, square)
    x += 1
    assert step() == 0
    assert_close(turned, [6, 2, 4])
    assert_close(square, 14)
    k[...] = 3  # a number is read by `bind`, an array by each call
    assert step() == 0 and turned[0] == 6
    assert function.bind(x, k, turned, square)() == 0 and turned[0] == 9
    with user_error(match="rotate: .*contiguous NumPy array"):
        function.bind(x, k, np.zeros(6, dtype())[::2], square)
    with user_error(match="bind takes 4 arrays, got 1"):
        function.bind(x)


@once
def test_no_derivative(controller, function, pendulum, key):
    x0 = jnp.array([0.1, 0.0])
    cost = lambda x0: dlx.rollout(pendulum, controller, key=key, x0=x0).total_cost
    with user_error(match="runs in C has no derivative"):
        jax.eval_shape(jax.grad(cost), x0)
    with user_error(match="runs in C has no derivative"):
        jax.grad(lambda x: function(x, 2)[1])(jnp.ones(3))


@once
@pytest.mark.parametrize(
    "call, match",
    [
        (lambda c, f: f(np.zeros(2), 1), r"shape \(3,\), got shape \(2,\)"),
        (lambda c, f: f(np.zeros(3), 1.5), "whole numbers"),
        (lambda c, f: f(np.zeros(3, complex), 1), "real numbers.*complex"),
        (lambda c, f: f([1, [2], 3], 1), "real numbers"),
        (lambda c, f: f(np.zeros(3)), "got 1 argument"),
        (lambda c, f: jax.jit(f)(jnp.zeros(2), 1), r"shape \(3,\), got"),
        (lambda c, f: f(np.zeros(3), 2**40), "k must fit in int32"),
        (lambda c, f: c(0.0, np.zeros(3), c.init()), "y must have shape \\(2,\\), got"),
        (lambda c, f: c(0.0, np.zeros(2), None), "state must be one that init"),
        (lambda c, f: c.applied(np.zeros(2), 0.0, c.init()), r"u must have .*\(1,\)"),
        (lambda c, f: c.running().step(0.0, np.zeros(3)), r"y must be .*\(2,\)"),
        (lambda c, f: c.running().applied(np.zeros(2), 0.0), r"u must be .*\(1,\)"),
    ],
)
def test_bad_arguments(controller, function, call, match):
    with user_error(match=match):
        call(controller, function)


@once
def test_what_cannot_be_loaded(folder, tmp_path, monkeypatch):
    with user_error(match="name must say which.*counting, rotate"):
        export.load(folder)
    with user_error(match="no export is called 'rotat'.*did you mean 'rotate'"):
        export.load(folder, name="rotat")
    with user_error(match="given to delucax.export.c.*none', which does not exist.$"):
        export.load(tmp_path / "none")
    hint = f"Pass {str(folder)!r} and name='rotate'.$"
    with user_error(match=f"does not exist. {hint}"):
        export.load(folder / "rotate")
    with user_error(match=f"is not a folder. {hint}"):
        export.load(folder / "rotate.c")
    monkeypatch.chdir(folder.parent)
    there = str(folder.parent / "absent")
    with user_error(match=rf"got 'absent' \({there!r}\), which does not exist.$"):
        export.load("absent")
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "law.h").touch()
    with user_error(match=r"holds no export. Its folders with headers are \['below'\]"):
        export.load(tmp_path)
    shutil.rmtree(tmp_path / "below")
    (tmp_path / "other.h").write_text("int other(void);\n")
    (tmp_path / "other.c").write_text("int other(void) { return 0; }\n")
    with user_error(match=f"{tmp_path.name}', which holds no export.$"):
        export.load(tmp_path)
    with user_error(match="flags must be a sequence"):
        export.load(folder, name="rotate", flags="-O2")
    with user_error(match="compiler must be the command"):
        export.load(folder, name="rotate", compiler=3)
    with user_error(match="no C compiler was found: looked for 'no-such-cc'"):
        export.load(folder, name="rotate", compiler="no-such-cc")
    with user_error(
        match="could not compile rotate.c with -no-such-flag:\n.*such-flag"
    ):
        export.load(folder, name="rotate", flags=("-no-such-flag",))
    monkeypatch.setenv("CC", "")
    monkeypatch.setenv("PATH", str(tmp_path))
    with user_error(match="looked for 'cc', 'gcc', 'clang'"):
        export.load(folder, name="rotate")


@once
def test_compiled_once(folder, tmp_path, monkeypatch):
    """The library is kept until the C, the compiler or the flags are others; where
    nothing can be kept it is made all the same."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    monkeypatch.setenv("HOME", str(tmp_path))
    real = shutil.which(os.environ.get("CC") or "cc")
    wrapper, log = tmp_path / "counted", tmp_path / "log"
    wrapper.write_text(f'#!/bin/sh\necho >> {log}\nexec {real} "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setenv("CC", str(wrapper))
    mine = tmp_path / "mine"
    shutil.copytree(folder, mine)
    calls = lambda: len(log.read_text().splitlines())
    for _ in range(2):
        export.load(mine, name="rotate")(np.ones(3), 1)
    assert calls() == 1
    assert sorted(p.name for p in mine.iterdir()) == sorted(os.listdir(folder))
    with open(mine / "rotate.c", "a") as source:
        source.write("/* changed */\n")
    export.load(mine, name="rotate")
    export.load(mine, name="rotate", flags=("-O1",))
    assert calls() == 3
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull)
    (_, square) = export.load(mine, name="rotate")(np.ones(3), 1)
    assert square == 3 and calls() == 4


@once
def test_it_is_a_module(controller):
    """Its functions are found again after a copy, and equal ones compile no more."""
    other = copy.deepcopy(controller)
    assert eqx.tree_equal(other, controller)
    u, _ = other(0.0, np.array([0.1, 0.0]), other.init())
    assert np.all(np.isfinite(u))
