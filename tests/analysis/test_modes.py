import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    central_difference,
    needs_x64,
    tolerance,
    user_error,
)

import delucax as dlx
from delucax.systems import LinearSystem


an = dlx.analysis


def random_system(seed, n, m, p):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) - 2 * np.eye(n)
    return A, rng.normal(size=(n, m)), rng.normal(size=(p, n))


def hidden(modes, reached, seed=0):
    """A pair with these eigenvalues, of which only some are reached."""
    rng = np.random.default_rng(seed)
    n = len(modes)
    T = np.linalg.qr(rng.normal(size=(n, n)))[0]
    B = rng.normal(size=(n, 1)) * np.asarray(reached)[:, None]
    return T @ np.diag(modes) @ T.T, T @ B


def test_krylov_matrices_are_controls():
    A, B, C = random_system(0, 4, 2, 3)
    system = LinearSystem(A, B, C)
    close = tolerance(1e-4, 1e-13)
    ours, theirs = an.controllability_matrix(system), control.ctrb(A, B)
    assert_close(ours, theirs, rtol=close, atol=close)
    ours, theirs = an.observability_matrix(system), control.obsv(A, C)
    assert_close(ours, theirs, rtol=close, atol=close)


@pytest.mark.parametrize("discrete", [False, True])
def test_unreached_modes_are_named(discrete):
    modes = [1.1, 0.5, -0.4, -1.3] if discrete else [0.7, -0.5, -0.4, -3.0]
    make = dlx.LinearDynamics if discrete else LinearSystem
    for missing in range(4):
        reached = [k != missing for k in range(4)]
        A, B = hidden(modes, reached)
        model = make(A, B)
        grows = abs(modes[missing]) >= 1 if discrete else modes[missing] >= 0
        assert not an.is_controllable(model)
        assert bool(an.is_stabilizable(model)) is not grows
        test = an.modal_controllability(model)
        mode, distance = test.worst
        assert_close(mode, modes[missing], atol=tolerance(1e-5, 1e-12))
        assert distance < test.tolerance
        assert int(jnp.sum(test.rank_deficient)) == 1
        if grows:
            assert_close(test.worst_unstable[0], mode)
        dual = make(A.T, np.eye(4), C=B.T)
        assert not an.is_observable(dual)
        assert bool(an.is_detectable(dual)) is not grows
        shown = an.modal_observability(dual)
        assert_close(shown.worst[0], mode, atol=tolerance(1e-5, 1e-12))
    A, B = hidden(modes, [True] * 4)
    assert an.is_controllable(make(A, B)) and an.is_stabilizable(make(A, B))
    assert an.is_observable(make(A.T, np.eye(4), C=B.T))


def test_a_stable_model_has_no_worst_unstable_mode():
    test = an.modal_controllability(LinearSystem(-jnp.eye(2), jnp.ones((2, 1))))
    assert jnp.isinf(test.worst_unstable[1])
    # One input cannot reach both of two equal modes.
    assert jnp.all(test.rank_deficient) and an.is_stabilizable(
        LinearSystem(-jnp.eye(2), jnp.ones((2, 1)))
    )


@pytest.mark.parametrize("A", [np.eye(2), np.diag([1.0, 0.5]), np.full((2, 2), 0.5)])
def test_a_mode_on_the_boundary_is_not_stable(A):
    steps = dlx.LinearDynamics(A, np.zeros((2, 1)))
    assert not an.is_stabilizable(steps)


def test_a_defective_mode_is_found_though_it_is_known_to_half_the_digits():
    # A chain of two at 0.5 that the input reaches, and one more that it does not.
    A = np.diag([0.5, 0.5, 0.5, -1.0]) + np.diag([1.0, 0, 0], 1)
    B = np.array([[0.0], [1.0], [0.0], [1.0]])
    T = np.linalg.qr(np.random.default_rng(3).normal(size=(4, 4)))[0]
    system = LinearSystem(T @ A @ T.T, T @ B)
    assert not an.is_controllable(system)
    assert not an.is_stabilizable(system)
    A[2, 2] = -0.6
    B[2] = 1.0
    assert an.is_controllable(LinearSystem(T @ A @ T.T, T @ B))


def test_modal_distance_is_that_of_a_uniform_search():
    A, B, _ = random_system(5, 3, 1, 1)
    test = an.modal_controllability(LinearSystem(A, B))
    for mode, distance in zip(test.modes, test.distances, strict=True):
        pencil = np.hstack(
            [(A - complex(mode) * np.eye(3)) / np.linalg.norm(A), B / np.linalg.norm(B)]
        )
        least = np.linalg.svd(pencil, compute_uv=False)[-1]
        assert_close(distance, least, rtol=tolerance(1e-4, 1e-11))


def test_modal_tests_under_jit_and_vmap():
    pairs = [hidden([0.5, -1.0], r) for r in ([True, True], [False, True])]
    As, Bs = (jnp.asarray(np.stack(m)) for m in zip(*pairs, strict=True))
    found = jax.jit(jax.vmap(lambda A, B: an.is_stabilizable(LinearSystem(A, B))))(
        As, Bs
    )
    assert list(np.asarray(found)) == [True, False]


def test_tolerance_and_inputs_decide():
    A = jnp.diag(jnp.array([1.0, 2.0]))
    weak = LinearSystem(A, jnp.array([[1.0], [1e-3]]), E=jnp.array([[1.0], [0.0]]))
    assert an.is_controllable(weak)
    assert not an.is_controllable(weak, tolerance=1e-2)
    assert not an.is_controllable(weak, inputs="disturbances")


@needs_x64
def test_poles_follow_the_model():
    def real_part(A):
        return jnp.max(jnp.real(an.poles(LinearSystem(A, jnp.ones((3, 1))))))

    A = jnp.asarray(random_system(7, 3, 1, 1)[0])
    expected = np.max(np.linalg.eigvals(np.asarray(A)).real)
    assert_close(real_part(A), expected, rtol=1e-13)
    numeric = central_difference(real_part, A)
    assert_close(jax.grad(real_part)(A), numeric, atol=1e-7)
    assert_close(jax.jacfwd(real_part)(A), numeric, atol=1e-7)


@pytest.mark.parametrize("n, m, p", [(2, 1, 1), (5, 1, 1), (6, 2, 2), (6, 2, 1)])
def test_zeros_make_the_pencil_lose_rank(n, m, p):
    A, B, C = random_system(n, n, m, p)
    found = np.asarray(an.zeros(LinearSystem(A, B, C)))
    # Generically a square plant has n - m, and one that is not square has none.
    assert len(found) == (n - m if m == p else 0)
    for z in found:
        pencil = np.block([[A - z * np.eye(n), B], [C, np.zeros((p, m))]])
        values = np.linalg.svd(pencil, compute_uv=False)
        assert values[-1] < tolerance(1e-5, 1e-11) * values[0]
    if m == p:
        theirs = np.sort_complex(control.ss(A, B, C, 0).zeros())
        close = tolerance(1e-3, 1e-9)
        assert_close(np.sort_complex(found), theirs, rtol=close, atol=close)


def test_zeros_of_chosen_places_and_relative_degree():
    # (s + 2)(s - 3) / ((s + 1)(s + 2)(s + 4)(s + 5)(s + 6)), with the pole at -2 kept.
    numerator = np.poly([-2.0, 3.0])
    denominator = np.poly([-1.0, -2.0, -4.0, -5.0, -6.0])
    model = control.ss(control.tf(numerator, denominator))
    found = an.zeros(LinearSystem(model.A, model.B, model.C))
    assert_close(np.sort_complex(found), [-2, 3], atol=tolerance(1e-3, 1e-10))
    # What no input reaches stays a zero, with the outputs taken away.
    A = jnp.diag(jnp.array([-1.0, -7.0]))
    B = jnp.array([[1.0], [0.0]])
    assert_close(an.zeros(LinearSystem(A, B, C=jnp.ones((1, 2)))), [-7], rtol=1e-6)
    assert an.zeros(LinearSystem(A, jnp.eye(2))).shape == (0,)


def test_bad_models_are_refused():
    A, B = jnp.eye(2), jnp.ones((2, 1))
    varying = dlx.LinearDynamics(jnp.stack([A, A]), B)
    for function in (an.poles, an.is_controllable, an.hinf_norm, an.dcgain):
        with user_error(match="must be a LinearSystem or LinearDynamics"):
            function(dlx.systems.Pendulum())
        with user_error(match="time-invariant, got matrices at 2 times"):
            function(varying)
    with user_error(match="'controls' or 'disturbances', got 'noise'"):
        an.h2_norm(LinearSystem(A, B), inputs="noise")
    with user_error(match="needs a model with E"):
        an.h2_norm(LinearSystem(A, B), inputs="disturbances")
    with user_error(match="tolerance must be positive"):
        an.is_observable(LinearSystem(A, B), tolerance=-1.0)
    with user_error(match="zeros: model must be concrete"):
        jax.jit(lambda A: an.zeros(LinearSystem(A, B)))(A)
