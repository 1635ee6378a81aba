"""Errors name the argument, the stage and the entry."""

import jax
import numpy as np
import pytest
from helpers import once

import delucax as dlx


pytestmark = once
A, B = np.eye(2), np.ones((2, 1))
Q, R = np.eye(2), np.eye(1)
Dense, Staged, Rows, Soft = dlx.qp.Dense, dlx.qp.Staged, dlx.qp.Rows, dlx.qp.Soft


def stages(matrix, count=3):
    return np.broadcast_to(matrix, (count, *matrix.shape)).copy()


def bent():
    matrices = stages(Q)
    matrices[1] = np.diag([1.0, -0.5])
    return matrices


def crossed():
    low = np.zeros((4, 2))
    low[2, 1] = 5
    return low, 1.0


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Dense(np.ones((2, 3)), np.ones(2)), "Dense: P must have shape (3, 3)"),
        (lambda: Dense(-Q, np.ones(2)), "not convex: P must be positive semidefinite"),
        (lambda: Dense([[1, 1], [0, 1]], np.ones(2)), "Dense: P must be symmetric"),
        (lambda: Dense(Q, [np.nan, 1]), "Dense: q must not be NaN, but its entry (0,)"),
        (lambda: Dense(Q, [1, 2], bounds=(1.0, 0.0)), "those are 1.0 and 0.0"),
        (lambda: Dense(Q, [1, 2], bounds=([0, 1], 0.5)), "those of entry 1 are 1.0"),
        (lambda: Dense(Q, [1, 2], rows=Rows(np.eye(3))), "C of rows must have shape"),
        (lambda: Dense(Q, [1, 2], equalities=(Q, [1.0])), "b must have shape (2,)"),
        (lambda: Dense(np.eye(3), [1, 2]), "Dense: q must have shape (3,)"),
        (lambda: Soft(1, 0), "Soft: bounds must have a finite number between"),
        (lambda: Staged(A, B, None, R, horizon=3), "Staged: Q must be an array"),
        (lambda: Soft(0, 1, linear=-1), "Soft: linear must be at least 0"),
        (lambda: Staged(A, B, Q, R), "Staged: horizon must be given"),
        (
            lambda: Staged(A, B, stages(Q), R, horizon=4),
            "must have the same number of stages",
        ),
        (
            lambda: Staged(A, np.ones((3, 1)), Q, R, horizon=3),
            "A must have shape (3, 3)",
        ),
        (lambda: Staged(A, B, bent(), R), "at stage 1 its smallest eigenvalue is -0.5"),
        (
            lambda: Staged(A, B, Q, R, horizon=3, states=crossed()),
            "those of entry 1 of stage 2 are 5.0 and 1.0",
        ),
        (
            lambda: Staged(A, B, Q, R, horizon=3, d=np.ones(3)),
            "d must have shape (2,) or (T, 2), got shape (3,)",
        ),
        (lambda: dlx.qp.solve(Dense(Q, [1, 2]), rtol=-1.0), "solve: rtol must be"),
    ],
)
def test_bad_input(make, words):
    with pytest.raises(ValueError) as error:
        make()
    assert words in str(error.value)


def test_an_infeasible_program_says_where():
    problem = Staged(
        A, B, Q, R, horizon=3, start=np.ones(2), controls=(-0.1, 0.1), states=(-9, 0.5)
    )
    with pytest.raises(
        RuntimeError, match="The constraints cannot all hold.* at stage 1 contributes"
    ):
        dlx.qp.solve(problem)


def test_equations_that_contradict_each_other_are_named():
    problem = Dense(Q, [1, 2], equalities=(np.ones((2, 2)), [1.0, 2.0]))
    with pytest.raises(RuntimeError, match="Row . of equalities contributes most"):
        dlx.qp.solve(problem)


def test_a_start_must_fit():
    solution = dlx.qp.solve(Dense(Q, [1, 2]))
    for problem in (
        Dense(np.eye(3), np.ones(3)),
        Dense(Q, [1, 2], bounds=(-1, 1)),
        Staged(A, B, Q, R, horizon=3),
    ):
        with pytest.raises(ValueError, match="solve: start must be the solution"):
            dlx.qp.solve(problem, start=solution)


def test_what_a_trace_hides_has_a_status():
    @jax.jit
    def status(low, linear):
        rows = Rows(np.ones((1, 2)), upper=1.0, linear=linear)
        problem = Dense(Q, [-5.0, 0.0], bounds=(low, np.inf), rows=rows)
        return dlx.qp.solve(problem, throw=False).result

    assert status(-9.0, 1.0) == dlx.RESULTS.successful
    for given in ((np.inf, 1.0), (np.nan, 1.0), (-9.0, np.nan), (-9.0, -1.0)):
        assert status(*given) == dlx.RESULTS.ill_posed


def test_an_unbounded_program_says_so():
    with pytest.raises(RuntimeError, match="unbounded below"):
        dlx.qp.solve(Dense(np.zeros((1, 1)), np.ones(1), bounds=(-np.inf, 0.0)))
