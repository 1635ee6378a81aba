"""Every controller of the catalogue in C: in closed loop as in JAX, or refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c_programs import compiled, Controller, needs_compiler
from contracts.test_controllers import A, B, CASES

import delucax as dlx
from delucax import export


pytestmark = needs_compiler
STEPS = 12
DRAW = {
    "BPC",
    "Categorical",
    "Explore",
    "Gaussian",
    "Gaussian of PID",
    "MPC that samples",
    "Random",
}


def file_name(label):
    return "".join(c if c.isalnum() else "_" for c in label).lower()


def in_jax(controller):
    """The observations and controls of a closed loop, with disturbances."""
    w = jnp.asarray(np.random.default_rng(0).normal(0, 0.05, (STEPS, 2)))
    state, static = eqx.partition(controller.init(key=None), eqx.is_array)

    def step(carry, inputs):
        x, arrays = carry
        k, w = inputs
        u, after = controller(0.1 * k, x, eqx.combine(arrays, static))
        after = controller.applied(u, 0.1 * k, after)
        return (A @ x + B @ u + w, eqx.filter(after, eqx.is_array)), (x, u)

    start = jnp.array([0.5, -0.3]), state
    return jax.jit(lambda: jax.lax.scan(step, start, (jnp.arange(STEPS), w))[1])()


def test_every_controller(tmp_path):
    made, refused = {}, set()
    for label, case in CASES.items():
        controller = case.make(1.0)
        try:
            name = file_name(label)
            export.c(controller, tmp_path, name=name, example=np.zeros(2))
            made[label] = controller
        except ValueError as error:
            assert "random" in str(error), label
            refused.add(label)
    assert refused == DRAW
    names = [file_name(label) for label in made]
    library = compiled(tmp_path, names)
    x64 = jax.config.jax_enable_x64  # pyright: ignore
    for label, controller in made.items():
        ys, us = map(np.asarray, in_jax(controller))
        program, k = Controller(tmp_path, file_name(label), library), 0
        for y, expected in zip(ys, us, strict=True):
            flag, u = program.step(0.1 * k, y)
            if np.all(np.isfinite(expected)):
                assert flag == 0, label
                scale = np.maximum(1, np.abs(expected))
                off = np.max(np.abs(u - expected) / scale)
                assert off < (1e-11 if x64 else 1e-3), (label, k, u, expected)
            else:
                assert flag, label
            program.applied(u, 0.1 * k)
            k += 1


def law(**options):
    return dlx.controllers.PID([1.0], 2.0, 0.3, dt=0.1, output=0, **options)


@pytest.mark.parametrize("fallback", [None, [0.25]])
def test_answer_to_bad_numbers(tmp_path, fallback):
    options = dict(name="pid", example=np.zeros(2), dtype="float64", fallback=fallback)
    export.c(law(), tmp_path, **options)
    program = Controller(tmp_path, "pid", compiled(tmp_path, ["pid"]))
    answer = 0.0 if fallback is None else 0.25
    assert program.step(0.0, [np.nan, 0.0])[0] == 1
    assert program.step(0.0, [np.nan, 0.0])[1] == answer
    flag, good = program.step(0.0, [0.5, 0.0])
    assert flag == 0
    before = [np.copy(a) for a in program.state]
    for bad in ([np.inf, 0.0], [1e308, 0.0]):
        flag, u = program.step(0.0, bad)
        assert flag == (1 if np.isinf(bad[0]) else 2)
        assert u == (good if fallback is None else 0.25)
    for a, b in zip(program.state, before, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_precision_is_not_that_of_the_process(tmp_path, dtype):
    export.c(law(), tmp_path, name="pid", example=np.zeros(2), dtype=dtype)
    program = Controller(tmp_path, "pid", compiled(tmp_path, ["pid"]))
    third = np.dtype(dtype).type(1) / 3
    _, u = program.step(0.0, [third, 0.0])
    assert u.dtype == dtype
    # The proportional, integral and derivative part of the error of the first step.
    expected, _ = law()(0.0, jnp.array([third, 0.0]), law().init())
    np.testing.assert_allclose(u, expected, rtol=1e-6)
