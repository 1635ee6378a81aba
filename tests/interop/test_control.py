import sys
import warnings

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import as_a_user, assert_close, needs_x64, user_error

import delucax as dlx
from delucax.interop import from_control, to_control
from delucax.systems import LinearSystem


A = jnp.array([[0.0, 1.0], [-2.0, -0.3]])
B = jnp.array([[0.0], [1.5]])
C = jnp.array([[1.0, 0.5]])
E = jnp.array([[0.2, 0.0], [0.0, 1.0]])
NAMES = {"state_names": ("angle", "rate"), "control_names": ("torque",)}


@pytest.mark.parametrize("discrete", [False, True])
def test_models_come_back(discrete):
    if discrete:
        model = dlx.LinearDynamics(A / 3, B, C, E, 0.25, **NAMES)
    else:
        model = LinearSystem(A, B, C, E, **NAMES)
    there = to_control(model, disturbances=True)
    assert there.dt == (0.25 if discrete else 0)
    assert there.input_labels == ["torque", "w0", "w1"]
    assert there.state_labels == ["angle", "rate"]
    assert np.all(there.D == 0)
    for disturbances in (("w0", "w1"), (1, 2)):
        back = from_control(there, disturbances=disturbances)
        assert type(back) is type(model)
        assert jax.tree.structure(back) == jax.tree.structure(model)
        leaves = zip(jax.tree.leaves(back), jax.tree.leaves(model), strict=True)
        for a, b in leaves:
            assert_close(a, b)
            assert a.dtype == b.dtype
    alone = to_control(model)
    assert alone.input_labels == ["torque"] and alone.B.shape == (2, 1)
    assert from_control(alone).E is None


def test_an_observed_state_names_the_outputs_and_comes_back():
    model = dlx.linearize(dlx.systems.Pendulum())
    there = to_control(model)
    assert there.output_labels == list(model.state_names)
    assert from_control(there).C is None
    assert to_control(LinearSystem(A, B, C)).output_labels == ["y[0]"]


def test_additive_disturbances_are_inputs_one_a_state():
    there = to_control(dlx.LinearDynamics(A / 3, B), disturbances=True)
    assert_close(there.B[:, 1:], np.eye(2))
    with user_error(match="needs a model with E"):
        to_control(LinearSystem(A, B), disturbances=True)


def test_a_chosen_order_of_disturbances_is_kept():
    system = control.ss(A, np.array([[1.0, 2, 3], [4, 5, 6]]), C, 0)
    model = from_control(system, disturbances=("u[2]", np.int64(0)))
    assert_close(model.E, [[3, 1], [6, 4]])
    assert_close(model.B, [[2], [5]])
    assert model.control_names == ("u[1]",)


def test_a_step_that_is_not_given_is_one():
    model = from_control(control.ss(A, B, C, 0, True))
    assert isinstance(model, dlx.LinearDynamics) and model.dt == 1


@needs_x64
def test_the_response_is_the_same():
    model = LinearSystem(A, B, C)
    omegas = np.logspace(-1, 1, 5)
    theirs = to_control(model)(1j * omegas)
    ours = dlx.analysis.frequency_response(model, omegas)[:, 0, 0]
    assert_close(ours, theirs, rtol=1e-12)
    times = np.linspace(0, 3, 31)
    _, steps = control.step_response(to_control(model), times)
    run = dlx.open_loop(dlx.c2d(model, 0.1), jnp.zeros(2), jnp.ones((30, 1)))
    assert_close(run @ C[0], steps, atol=1e-9)


def test_what_has_no_place_is_refused_by_name():
    with user_error(match=r"D must be zero.*got \[\[0.5\]\]"):
        from_control(control.ss(A, B, C, 0.5))
    with user_error(match="must say its time base.*got dt=None"):
        from_control(control.ss(A, B, C, 0, None))
    with user_error(match="must be a control.StateSpace.*got TransferFunction"):
        from_control(control.tf([1], [1, 1]))
    with warnings.catch_warnings():
        # python-control sets the shape of an empty array, of which NumPy warns.
        warnings.simplefilter("ignore", DeprecationWarning)
        static = control.ss([], [], [], [[0.0]], 0)
    with user_error(match="must have states, got none"):
        from_control(static)
    plain = control.ss(A, B, C, 0)
    for wrong in ("wind", 1, 0.0):
        with user_error(match=r"among the inputs \['u\[0\]'\]"):
            from_control(plain, disturbances=(wrong,))
    with user_error(match="disturbances must be different inputs"):
        from_control(plain, disturbances=("u[0]", 0))
    with user_error(match="to_control: model must be a LinearSystem"):
        to_control(dlx.systems.Pendulum())
    with user_error(match="time-invariant, got matrices at 2 times"):
        to_control(dlx.LinearDynamics(jnp.stack([A, A]), B))
    with user_error(match="must be concrete"):
        jax.jit(lambda A: to_control(LinearSystem(A, B)).A)(A)


def test_without_python_control_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    with as_a_user(), pytest.raises(ImportError, match=r"delucax\[control\]"):
        to_control(LinearSystem(A, B))
    with as_a_user(), pytest.raises(ImportError, match=r"delucax\[control\]"):
        from_control(None)
