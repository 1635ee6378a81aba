"""What the C says where it cannot say the right thing, and what it keeps then."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c_programs import exported
from helpers import needs_compiler, once
from jax import lax

import delucax as dlx
from delucax import export


pytestmark = [needs_compiler, once]
PID = dlx.controllers.PID(10.0, 5.0, 1.0, dt=0.05)


class Counts(dlx.AbstractController):
    """With a state that JAX does not see."""

    def init(self, *, key=None):
        return {"n": 0}

    def __call__(self, t, y, state):
        return y[:1] + state["n"], {"n": state["n"] + 1}


class Scalar(dlx.AbstractController):
    def __call__(self, t, y, state):
        return y[0], state


def test_applied_keeps_a_good_state(tmp_path):
    export.c(PID, tmp_path, name="pid", example=np.zeros(1))
    good, bad = (export.load(tmp_path).running() for _ in range(2))
    for law in (good, bad):
        law.step(0.0, [1.0])
    bad.applied([np.nan], 0.0)
    assert bad.step(0.05, [1.0]) == good.step(0.05, [1.0])
    assert bad.flag == 0


@pytest.mark.parametrize("most, flag", [(3, 2), (98, 2), (99, 0), (100, 0)])
def test_a_loop_that_is_cut_off_sets_the_flag(tmp_path, most, flag):
    count = lambda x: lax.while_loop(lambda c: c < 100, lambda c: c + 1, x)
    options = dict(name="count", example=(1.0,), max_iterations=most)
    export.c(count, tmp_path, **options)
    given, out = (np.zeros((), jnp.zeros(()).dtype) for _ in range(2))
    given[...] = 1
    assert export.load(tmp_path).bind(given, out)() == flag
    assert out == min(1 + most, 100)


def test_a_batch_of_loops(tmp_path):
    def count(n, x):
        turn = lambda c: (c[0] + 1, c[1] + x)
        return lax.while_loop(lambda c: c[0] < 10, turn, (n, x))

    starts, x = jnp.array([1, 5, 9]), jnp.ones(3)
    batch = jax.vmap(count)
    options = dict(name="batch", example=(starts, x), max_iterations=20)
    export.c(batch, tmp_path, **options)
    found = export.load(tmp_path)(*map(np.asarray, (starts, x)))
    for a, b in zip(found, batch(starts, x), strict=True):
        np.testing.assert_array_equal(a, b)


def test_flags_that_remove_the_tests_for_nan_are_refused(tmp_path):
    export.c(PID, tmp_path, name="pid", example=np.zeros(1))
    with pytest.raises(ValueError, match="compile this without -ffast-math"):
        export.load(tmp_path, flags=["-O2", "-ffast-math"])


def test_names_and_units_of_a_plant(tmp_path):
    env = dlx.make("pendulum")
    K = np.array([[20.0, 5.0]])
    law = dlx.controllers.Linear(K)
    export.c(law, tmp_path, name="law", plant=env.dynamics)
    words = (tmp_path / "law.h").read_text()
    for line in ("t [s]", "u[0]: torque [N m]", "y[1]: velocity [rad/s]"):
        assert f" *   {line}" in words
    with pytest.raises(ValueError, match="plant must have 1 controls"):
        export.c(law, tmp_path, name="law", plant=dlx.systems.Quadrotor())


def test_what_no_c_can_do_is_refused(tmp_path):
    y = np.zeros(2)
    for given, example, words in (
        (Counts(), y, "What changes must be a JAX array"),
        (Scalar(), y, r"must return a control of shape \(m,\), got"),
    ):
        with pytest.raises(ValueError, match=words):
            export.c(given, tmp_path, name="none", example=example)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["motor_b", "c2", "pid_f1"])
def test_names_that_only_look_like_ours(tmp_path, name):
    export.c(PID, tmp_path, name=name, example=np.zeros(1))
    export.load(tmp_path)
    f = lambda sinf, f_real, v2: sinf + f_real * v2
    export.c(f, tmp_path, name="f", example=(1.0, 2.0, 3.0))
    assert export.load(tmp_path, name="f")(1.0, 2.0, 3.0) == 7


def test_types_beside_that_of_the_export(tmp_path):
    K, rows = np.arange(1, 6, dtype=np.float32), np.arange(300.0)
    x, bits = np.arange(20.0), np.array([7, 3, 2**31 + 1], np.uint32)
    given = {
        "gains": (lambda x: (x[:5] @ K, jnp.asarray(K)), (x,)),
        "sums": (lambda x: jnp.cumsum(x) + jnp.cumsum(x.astype(jnp.float32)), (x,)),
        "entry": (lambda a, i: lax.dynamic_slice(a, (i,), (2,)), (rows, np.uint8(7))),
        "common": (lambda b: lax.reduce_and(b, axes=(0,)), (bits,)),
    }
    calls = exported(tmp_path, given, dtype="float64")
    found = {name: call(*given[name][1]) for name, call in calls.items()}
    assert {flag for flag, _ in found.values()} == {0}
    (total, gains), (sums,), (entry,), (common,) = (out for _, out in found.values())
    assert total == 40 and np.all(gains == K) and gains.dtype == float
    np.testing.assert_allclose(sums, 2 * np.cumsum(x))
    assert list(entry) == [7, 8] and common == 1


@pytest.mark.parametrize("limit", [1.0, 20.0])
def test_a_counter_that_is_rounded_bounds_its_loop(tmp_path, limit):
    """With thousandths in single precision the number of sums is not the quotient."""

    def count(x):
        turn = lambda c: (c[0] + jnp.float32(0.001), c[1] + x)
        start = jnp.float32(0), jnp.float32(0)
        return lax.while_loop(lambda c: c[0] < jnp.float32(limit), turn, start)[1]

    one = np.float32(1)
    given = {"count": (count, (one,))}
    flag, (found,) = exported(tmp_path, given, dtype="float32")["count"](one)
    assert (flag, found) == (0, count(one))


def test_a_counter_that_may_step_over_its_end_has_no_bound(tmp_path):
    turn = lambda c: (c[0] + jnp.float32(0.1), c[1] + 1)
    ends = lambda x: lax.while_loop(lambda c: c[0] != 1, turn, (jnp.float32(0), x))[1]
    with pytest.raises(ValueError, match="give max_iterations"):
        export.c(ends, tmp_path, name="ends", dtype="float32", example=(np.float32(1),))
