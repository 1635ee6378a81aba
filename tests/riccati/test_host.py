"""Concrete matrices are solved by NumPy, traced ones by compiled programs."""

import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import counted_programs, needs_x64, once

import delucax as dlx
from delucax._host import on_host
from delucax.riccati import _stabilising


riccati, controllers, analysis = dlx.riccati, dlx.controllers, dlx.analysis
linear: Any = dlx.LinearDynamics
system: Any = dlx.systems.LinearSystem
A = np.array([[1.1, 0.3], [0.0, 0.7]])
B = np.array([[0.0], [1.0]])
Q, R, C = np.eye(2), np.eye(1), np.eye(2)[:1]
TIMES = np.linspace(0.0, 2.0, 5)
NO_THROW = dict(throw=False)
EQUATIONS = {
    "dare": lambda A: riccati.dare(A, B, Q, R, **NO_THROW),
    "care": lambda A: riccati.care(A, B, Q, R, **NO_THROW),
    "descriptor": lambda A: riccati.care(A, B, Q, R, E=2 * np.eye(2), **NO_THROW),
    "complex": lambda A: riccati.dare(A + 0j, B, Q, R, **NO_THROW),
    "filter_dare": lambda A: riccati.filter_dare(A, C, Q, R, **NO_THROW),
    "filter_care": lambda A: riccati.filter_care(A, C, Q, R, **NO_THROW),
    "lyap": lambda A: riccati.lyap(A - 2 * Q, Q, **NO_THROW),
    "lyap, not stable": lambda A: riccati.lyap(A - Q, Q, **NO_THROW),
    "dlyap": lambda A: riccati.dlyap(A / 2, Q, **NO_THROW),
    "dlyap, not stable": lambda A: riccati.dlyap(A, Q, **NO_THROW),
    "sylvester": lambda A: riccati.sylvester(A, R, B, **NO_THROW),
    "dsylvester": lambda A: riccati.dsylvester(A / 2, R, B, **NO_THROW),
    "hinf_dare": lambda A: riccati.hinf_dare(A, B, None, Q, R, **NO_THROW),
    "hinf_care": lambda A: riccati.hinf_care(A, B, None, Q, R, gamma=20.0, **NO_THROW),
    "dre": lambda A: riccati.dre(A, B, Q, R, horizon=5, d=np.ones(2), **NO_THROW),
    "dre, parallel": lambda A: riccati.dre(
        A, B, Q, R, horizon=5, parallel=True, **NO_THROW
    ),
    "cre": lambda A: riccati.cre(A, B, Q, R, times=TIMES, **NO_THROW),
    "hinf_dre": lambda A: riccati.hinf_dre(A, B, None, Q, R, horizon=5, **NO_THROW),
    "hinf_cre": lambda A: riccati.hinf_cre(
        A, B, None, Q, R, times=TIMES, gamma=9.0, **NO_THROW
    ),
}
DESIGNS = {
    "LQR": lambda A: controllers.LQR(linear(A, B), Q, R),
    "LQI": lambda A: controllers.LQI(linear(A, B), np.eye(3), R, output=C),
    "LQG": lambda A: controllers.LQG(linear(A, B, C), Q, R, Q, R),
    "HInfinity": lambda A: controllers.HInfinity(linear(A, B), Q, R),
    "lqrd": lambda A: controllers.lqrd(system(A, B), Q, R, dt=0.1),
}
MODELS = {
    "discrete": lambda A: linear(A / 2, B, C, dt=0.5),
    "continuous": lambda A: system(A - 2 * Q, B, C),
}


def modal_test(model):
    test = analysis.modal_controllability(model)
    return test.rank_deficient, test.worst, test.worst_unstable


OF_MODELS = {
    "frequency_response": lambda M: analysis.frequency_response(
        M, np.array([0.1, 2.0])
    ),
    "dcgain": analysis.dcgain,
    "h2_norm": analysis.h2_norm,
    "hinf_norm": analysis.hinf_norm,
    "margins": analysis.margins,
    "disk_margin": lambda M: analysis.disk_margin(M, 0.5, channel=0),
    "controllability_matrix": analysis.controllability_matrix,
    "observability_matrix": analysis.observability_matrix,
    "controllability_gramian": analysis.controllability_gramian,
    "observability_gramian": lambda M: analysis.observability_gramian(M, 3),
    "modal_controllability": modal_test,
    "is_observable": analysis.is_observable,
    "is_stabilizable": analysis.is_stabilizable,
    "poles": analysis.poles,
    "c2d": lambda M: (dlx.c2d(M, 0.5), dlx.c2d(M, 0.5, "tustin")),
    "d2c": lambda M: (dlx.d2c(M), dlx.d2c(M, "tustin")),
}
OF_ONE_KIND = dict(c2d="continuous", d2c="discrete")
ANALYSES = {
    f"{name}, {kind}": lambda A, of=of, model=model: of(model(A))
    for name, of in OF_MODELS.items()
    for kind, model in MODELS.items()
    if OF_ONE_KIND.get(name, kind) == kind
}
# The rest is compared beside the test of its derivatives, which compiles it, or is made
# of these.
COMPARED = [
    "h2_norm, discrete",
    "controllability_gramian, continuous",
    "observability_gramian, continuous",
    "observability_matrix, discrete",
    "modal_controllability, continuous",
    "is_stabilizable, discrete",
    "dcgain, discrete",
    "c2d, continuous",
    "d2c, discrete",
]


def test_programs_are_counted():
    with counted_programs() as events:
        jax.jit(lambda x: x + 17)(jnp.zeros(())).block_until_ready()
    assert events


@pytest.fixture(scope="module")
def nothing_was_compiled():
    jax.clear_caches()


SPINE = "dare", "care"
REST = [name for name in EQUATIONS | DESIGNS | ANALYSES if name not in SPINE]


@pytest.mark.parametrize(
    "name", [*SPINE, *(pytest.param(name, marks=once) for name in REST)]
)
@pytest.mark.usefixtures("nothing_was_compiled")
def test_nothing_is_compiled(name):
    with counted_programs() as events:
        solution = (EQUATIONS | DESIGNS | ANALYSES)[name](A)
    assert not events
    leaves = [leaf for leaf in jax.tree.leaves(solution) if hasattr(leaf, "dtype")]
    assert leaves
    bits = jnp.finfo(jnp.result_type(float)).bits
    for leaf in leaves:
        assert isinstance(leaf, jax.Array)
        if jnp.issubdtype(leaf.dtype, jnp.inexact):
            assert jnp.finfo(leaf.dtype).bits == bits


@needs_x64
@pytest.mark.parametrize("name", ["lyap, not stable", "dsylvester"])
def test_both_ways_agree(name):
    """The tests of derivatives compare the compiled solutions of the other equations
    with those by NumPy, `test_dare.py` and `test_care.py` those of regulators, and
    `test_darex.py` has complex ones."""
    at_once, compiled = EQUATIONS[name](A), jax.jit(EQUATIONS[name])(A)
    assert at_once.result == compiled.result
    np.testing.assert_allclose(at_once.X, compiled.X, rtol=1e-11, atol=1e-11)


@needs_x64
@pytest.mark.parametrize("name", COMPARED)
def test_both_ways_of_an_analysis_agree(name):
    at_once, compiled = ANALYSES[name](A), jax.jit(ANALYSES[name])(A)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11),
        at_once,
        compiled,
    )
    types = [[x.dtype for x in jax.tree.leaves(tree)] for tree in (at_once, compiled)]
    assert types[0] == types[1]


@once
def test_single_precision_of_data_is_kept():
    with jax.enable_x64(True):
        single = [M.astype(np.float32) for M in (A, B, Q, R)]
        assert riccati.dare(*single).X.dtype == jnp.float32
        assert riccati.hinf_care(*single[:2], None, *single[2:]).X.dtype == jnp.float32
        assert riccati.dare(*single[:3], R).X.dtype == jnp.float64
        model = system(*(M.astype(np.float32) for M in (-Q, B, C)))
        for name in OF_MODELS.keys() - OF_ONE_KIND.keys():
            for leaf in jax.tree.leaves(OF_MODELS[name](model)):
                inexact = jnp.issubdtype(leaf.dtype, jnp.inexact)
                assert not inexact or jnp.finfo(leaf.dtype).bits == 32


@once
def test_constants_of_a_program_are_solved_when_it_is_traced():
    def program(x):
        return riccati.dare(A, B, Q, R).X @ x

    assert "while" not in str(jax.make_jaxpr(program)(jnp.ones(2)))
    expected = EQUATIONS["dare"](A).X @ np.ones(2)
    np.testing.assert_allclose(jax.jit(program)(jnp.ones(2)), expected, rtol=1e-6)
    # And what is not constant is compiled with the program.
    assert "while" in str(jax.make_jaxpr(EQUATIONS["dare"])(A))


@once
def test_transformations_and_threads():
    def recursion(A):
        return riccati.dre(A, B, Q, R, horizon=2, **NO_THROW).X[0]

    expected = recursion(A)
    with jax.ensure_compile_time_eval():
        np.testing.assert_array_equal(recursion(A), expected)
    # The choice is one of a thread.
    solutions = []

    def solve():
        for _ in range(5):
            solutions.append(recursion(A))
        solutions.append(jax.jit(recursion)(A))
        assert not on_host()

    threads = [threading.Thread(target=solve) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(solutions) == 18
    for X in solutions:
        np.testing.assert_allclose(X, expected, rtol=1e-5)

    # A derivative, of which a part is a constant, in a batch.
    def cost(A, scale):
        return scale * jnp.trace(recursion(A)) + jnp.trace(expected)

    slopes = jax.jit(jax.vmap(jax.grad(cost), (None, 0)))(A, np.arange(1.0, 3.0))
    change = np.array([[0.3, -0.1], [0.2, 0.5]])
    up, down = (cost(A + h * change, 1.0) for h in (1e-2, -1e-2))
    slope = np.sum(np.asarray(slopes[0]) * change)
    np.testing.assert_allclose(slope, (up - down) / 2e-2, rtol=5e-3)
    np.testing.assert_allclose(slopes[1], 2 * slopes[0], rtol=1e-5)


def test_the_errors():
    with pytest.raises(RuntimeError) as error:
        riccati.dare(A, 0 * B, Q, R)
    assert str(error.value).startswith(
        f"dare: {dlx.RESULTS[dlx.RESULTS.not_stabilisable]} Relative residual "
    )
    assert str(error.value).endswith("Pass throw=False to look at the solution.")
    with pytest.raises(ValueError, match="care: R must be positive definite"):
        riccati.care(A, B, Q, -R)
    with pytest.raises(ValueError, match="dare: A must be finite"):
        riccati.dare(np.nan * A, B, Q, R)
    assert not on_host()


@pytest.mark.parametrize("by_numpy", [True, pytest.param(False, marks=once)])
def test_the_certificate_decides(by_numpy, monkeypatch):
    """One that is given an error which its Newton steps do not remove."""
    good = EQUATIONS["dare"](A)
    assert good.result == dlx.RESULTS.successful
    right, step = _stabilising.discrete_start, _stabilising._correction

    def start(data, height):
        X, steps = right(data, height)
        return 1.01 * X, steps

    monkeypatch.setattr(_stabilising, "discrete_start", start)
    monkeypatch.setattr(_stabilising, "_correction", lambda *args: 0 * step(*args))
    jax.clear_caches()
    wrong = EQUATIONS["dare"](A) if by_numpy else jax.jit(EQUATIONS["dare"])(A)
    jax.clear_caches()
    assert wrong.result != dlx.RESULTS.successful
    assert wrong.residual > 100 * good.residual
