"""Which Diffrax solvers fit, and how they are made to."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import PyTree, Scalar

from .._results import choose, promote, Result, RESULTS
from ._runge_kutta import tableau_of


def check_solver(solver: Any, where: str) -> None:
    """Raise unless `solver` is a Diffrax solver."""
    if not isinstance(solver, diffrax.AbstractSolver):
        raise ValueError(
            f"{where}: solver must be a Diffrax solver such as diffrax.Tsit5() (an "
            f"instance, not the class), got {solver!r}."
        )


def check_stepsize_controller(stepsize_controller: Any, where: str) -> None:
    """Raise unless `stepsize_controller` chooses steps by their error."""
    if not isinstance(stepsize_controller, diffrax.AbstractAdaptiveStepSizeController):
        raise ValueError(
            f"{where}: stepsize_controller must be adaptive, such as "
            "diffrax.PIDController(rtol=1e-6, atol=1e-8); for fixed steps leave it "
            f"out and give substeps. Got {stepsize_controller!r}."
        )


def check_adjoint(adjoint: Any, where: str) -> None:
    """Raise unless `adjoint` is a Diffrax adjoint."""
    if not isinstance(adjoint, diffrax.AbstractAdjoint):
        raise ValueError(
            f"{where}: adjoint must be a Diffrax adjoint such as "
            f"diffrax.RecursiveCheckpointAdjoint(), got {adjoint!r}."
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


def outcome(solution: diffrax.Solution, controller: Any, dtype: Any) -> Result:
    """What became of a solve. Where the steps ran out, and the tolerance is finer than
    rounding of the state, it is the tolerance that is to blame."""
    result = promote(solution.result)
    while not hasattr(controller, "rtol") and hasattr(controller, "controller"):
        controller = controller.controller
    rtol = getattr(controller, "rtol", 1.0)
    fine = rtol < 4 * float(jnp.finfo(dtype).eps)
    if fine is False:
        return result
    blamed = fine & (result == RESULTS.max_steps_reached)
    return choose(blamed, RESULTS.beyond_precision, result)


class AbstractTransparentSolver(diffrax.AbstractWrappedSolver):
    """A solver around another, which Diffrax sees through."""

    solver: eqx.AbstractVar[diffrax.AbstractSolver]

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def term_compatible_contr_kwargs(self):
        return self.solver.term_compatible_contr_kwargs

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.solver.interpolation_cls

    # Diffrax looks for these on what passes for an implicit or Runge-Kutta solver.

    @property
    def root_finder(self):
        return self.solver.root_finder  # pyright: ignore

    @property
    def root_find_max_steps(self):
        return self.solver.root_find_max_steps  # pyright: ignore

    @property
    def scan_kind(self):
        return self.solver.scan_kind  # pyright: ignore

    def order(self, terms):
        return self.solver.order(terms)

    def strong_order(self, terms):
        return self.solver.strong_order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)


class _Chord(optx.AbstractRootFinder):
    """Diffrax's chord method, which iterates until it has converged.

    Diffrax's own gives up after two iterations, for a step-size controller to take a
    shorter step. Fixed steps have none, so this one goes on while it contracts.
    """

    rtol: Any
    atol: Any
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


class _FixedStep(AbstractTransparentSolver):
    """An implicit solver that needs no step-size controller for its tolerances.

    What is solved for is a slope, or its product with the step. Where the field is
    stiff rounding of the state alone makes slopes rough, so the tolerance is that of
    the state: relative to it, whatever the slope.
    """

    solver: diffrax.AbstractSolver

    @property
    def root_finder(self):
        return self._with_tolerances(1.0).root_finder

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        rtol, atol = _tolerances(y0.dtype)
        scale = lax.stop_gradient(atol + rtol * jnp.abs(y0))
        tableau = getattr(self.solver, "tableau", None)
        if tableau is not None and tableau.fsal:  # then Diffrax solves for the slope
            scale = scale / lax.stop_gradient(t1 - t0)
        solver = self._with_tolerances(scale, rtol)
        return solver.step(terms, t0, t1, y0, args, solver_state, made_jump)

    def _with_tolerances(self, atol: Any, rtol: float = 1e-3) -> Any:
        finder = self.solver.root_finder  # pyright: ignore
        if isinstance(finder, diffrax.VeryChord | optx.Chord):
            finder = _Chord(rtol=rtol, atol=atol, linear_solver=finder.linear_solver)
        else:
            values = {"rtol": rtol, "atol": atol, "norm": optx.rms_norm}
            names = _unset(finder)
            finder = eqx.tree_at(
                lambda f: [getattr(f, name) for name in names],
                finder,
                [values[name] for name in names],
                is_leaf=lambda leaf: leaf is getattr(finder, names[0]),
            )
        return eqx.tree_at(lambda s: s.root_finder, self.solver, finder)


def _tolerances(dtype: Any) -> tuple[float, float]:
    return (1e-10, 1e-12) if dtype == jnp.float64 else (1e-5, 1e-6)


def _unset(finder: Any) -> list[str]:
    """The tolerances that a root finder leaves to a step-size controller."""
    # Diffrax's mark for them has no public name.
    return [
        name
        for name in ("rtol", "atol", "norm")
        if "stepsize" in repr(getattr(finder, name, None)).replace("_", "")
    ]


def for_fixed_steps(solver: Any) -> Any:
    """An implicit solver that works without a step-size controller and outside of
    `diffeqsolve`, and can be differentiated both ways there.
    """
    if getattr(solver, "scan_kind", "bounded") is None:
        solver = eqx.tree_at(
            lambda s: s.scan_kind, solver, "bounded", is_leaf=lambda x: x is None
        )
    return _FixedStep(solver) if _unset(solver.root_finder) else solver


def loud(adjoint: diffrax.AbstractAdjoint) -> diffrax.AbstractAdjoint:
    """An adjoint that raises where a solve of its own fails.

    The backward solve of `BacksolveAdjoint` takes over `throw` from the forward one,
    which has it off to return a status; a gradient has no status to be wrong by.
    """
    if not isinstance(adjoint, diffrax.BacksolveAdjoint):
        return adjoint
    return diffrax.BacksolveAdjoint(**({"throw": True} | adjoint.kwargs))
