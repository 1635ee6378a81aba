"""Which Diffrax solvers fit, and how they are made to."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import PyTree, Scalar

from ._runge_kutta import tableau_of


def check_solver(solver: Any, where: str) -> None:
    """Raise unless `solver` is a Diffrax solver."""
    if not isinstance(solver, diffrax.AbstractSolver):
        raise ValueError(
            f"{where}: solver must be a Diffrax solver such as diffrax.Tsit5() (an "
            f"instance, not the class), got {solver!r}."
        )


def check_fixed_step(solver: diffrax.AbstractSolver, where: str) -> None:
    """Raise unless `solver` takes fixed steps of `dx/dt = f(t, x, u, w)`."""
    if isinstance(solver, diffrax.AbstractImplicitSolver):
        _check_implicit(solver, where)
    elif tableau_of(solver) is None:
        raise ValueError(
            f"{where}: solver {type(solver).__name__} does not fit fixed steps of "
            "dx/dt = f(t, x, u, w); use an explicit Runge-Kutta method "
            "(diffrax.Euler, Heun, Midpoint, Ralston, Bosh3, Tsit5, Dopri5, Dopri8, "
            "delucax.dynamics.RK4) or a diagonally implicit one "
            "(diffrax.ImplicitEuler, Kvaerno3, Kvaerno4, Kvaerno5)."
        )


def check_adaptive(solver: diffrax.AbstractSolver, where: str) -> None:
    """Raise unless a step-size controller can steer `solver`."""
    name = type(solver).__name__
    tableau = tableau_of(solver)
    exact = tableau is not None and not tableau.b_error.any()
    if exact or not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        raise ValueError(
            f"{where}: solver {name} estimates no error, so a stepsize_controller "
            "cannot steer it; use diffrax.Tsit5(), or wrap it: "
            f"diffrax.HalfSolver({name}())."
        )
    if isinstance(solver, diffrax.AbstractImplicitSolver):
        _check_implicit(solver, where)


def _check_implicit(solver: diffrax.AbstractSolver, where: str) -> None:
    if solver.term_structure is not diffrax.AbstractTerm:
        raise ValueError(
            f"{where}: solver {type(solver).__name__} needs a split into stiff and "
            "non-stiff parts; use diffrax.ImplicitEuler, Kvaerno3, Kvaerno4 or "
            "Kvaerno5."
        )
    if not hasattr(solver, "root_finder"):
        raise ValueError(
            f"{where}: solver {type(solver).__name__} hides the root finder of the "
            "implicit solver that it wraps; use that one by itself."
        )


class _Chord(optx.AbstractRootFinder):
    """Diffrax's chord method, which iterates until it has converged.

    Diffrax's own gives up after two iterations, for a step-size controller to take a
    shorter step. Fixed steps have none, so this one goes on while it contracts.
    """

    rtol: float
    atol: float
    linear_solver: lx.AbstractLinearSolver
    norm: Callable[[PyTree], Scalar] = optx.rms_norm

    @property
    def _chord(self):
        return diffrax.VeryChord(
            self.rtol, self.atol, self.norm, linear_solver=self.linear_solver
        )

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        return self._chord.init(fn, y, args, options, f_struct, aux_struct, tags)

    def step(self, fn, y, args, options, state, tags):
        return self._chord.step(fn, y, args, options, state, tags)

    def terminate(self, fn, y, args, options, state, tags):
        del fn, y, args, options, tags
        size = state.diffsize  # of the last change, in units of the tolerance
        rate = size / state.diffsize_prev
        left = size * rate / (1 - rate)  # what is left to go, if it goes on like this
        enough = state.step >= 2
        # Close to the root rounding takes over, and the rate says nothing.
        converged = enough & ((size < 0.1) | (rate < 1) & (left < 0.01))
        lost = ~jnp.isfinite(size) | (rate > 2)
        diverged = enough & ~converged & lost
        result = optx.RESULTS.where(
            diverged, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        failed = state.result != optx.RESULTS.successful
        result = optx.RESULTS.where(failed, state.result, result)
        return failed | converged | diverged, result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return self._chord.postprocess(fn, y, aux, args, options, state, tags, result)


def for_one_step(solver: Any, dtype: Any) -> Any:
    """An implicit solver that works outside `diffeqsolve`: differentiable both ways,
    and with a root finder of its own where it would take a step-size controller's
    tolerances.
    """
    if getattr(solver, "scan_kind", "bounded") is None:
        solver = eqx.tree_at(
            lambda s: s.scan_kind, solver, "bounded", is_leaf=lambda x: x is None
        )
    finder = solver.root_finder
    # Diffrax's mark for a tolerance that is yet to come has no public name.
    names = [
        name
        for name in ("rtol", "atol", "norm")
        if "stepsize" in repr(getattr(finder, name, None)).replace("_", "")
    ]
    if not names:
        return solver
    double = dtype == jnp.float64
    rtol, atol = (1e-10, 1e-12) if double else (1e-5, 1e-6)
    if isinstance(finder, diffrax.VeryChord | optx.Chord):
        finder = _Chord(rtol=rtol, atol=atol, linear_solver=finder.linear_solver)
        return eqx.tree_at(lambda s: s.root_finder, solver, finder)
    values = {"rtol": rtol, "atol": atol, "norm": optx.rms_norm}
    return eqx.tree_at(
        lambda s: [getattr(s.root_finder, name) for name in names],
        solver,
        [values[name] for name in names],
        is_leaf=lambda leaf: leaf is getattr(finder, names[0]),
    )


def loud(adjoint: diffrax.AbstractAdjoint) -> diffrax.AbstractAdjoint:
    """An adjoint that raises where a solve of its own fails.

    The backward solve of `BacksolveAdjoint` takes over `throw` from the forward one,
    which has it off to return a status; a gradient has no status to be wrong by.
    """
    if not isinstance(adjoint, diffrax.BacksolveAdjoint):
        return adjoint
    return diffrax.BacksolveAdjoint(**({"throw": True} | adjoint.kwargs))
