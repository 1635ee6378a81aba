"""Checks of Diffrax solvers, and implicit solvers at fixed steps."""

import operator
from typing import Any

import diffrax
import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
import optimistix as optx

from .._results import choose, promote, Result, RESULTS
from ._runge_kutta import tableau_of


_KINDS: dict[str, tuple[type, str]] = {
    "solver": (
        diffrax.AbstractSolver,
        "a Diffrax solver such as diffrax.Tsit5() (an instance, not the class), got",
    ),
    "stepsize_controller": (
        diffrax.AbstractAdaptiveStepSizeController,
        "adaptive, such as diffrax.PIDController(rtol=1e-6, atol=1e-8); for fixed "
        "steps leave it out and pass substeps. Got",
    ),
    "adjoint": (
        diffrax.AbstractAdjoint,
        "a Diffrax adjoint such as diffrax.RecursiveCheckpointAdjoint(), got",
    ),
}


def check_kind(value: Any, name: str, where: str) -> None:
    """Raise unless `value` fits Diffrax's argument `name`."""
    kind, words = _KINDS[name]
    if not isinstance(value, kind):
        raise ValueError(f"{where}: {name} must be {words} {value!r}.")


def check_method(
    solver: Any,
    stepsize_controller: Any,
    substeps: int,
    max_steps: Any,
    where: str,
    *,
    with_diffusion: bool = False,
) -> None:
    """Raise if the solver is incompatible with the fixed or adaptive steps."""
    check_kind(solver, "solver", where)
    if stepsize_controller is not None:
        check_kind(stepsize_controller, "stepsize_controller", where)
        check_adaptive(solver, where)
        if substeps != 1:
            raise ValueError(
                f"{where}: substeps must be 1 with a stepsize_controller, which "
                f"chooses the steps itself, got {substeps}."
            )
    elif max_steps is not None:
        raise ValueError(
            f"{where}: max_steps needs a stepsize_controller. With fixed steps, pass "
            "substeps instead."
        )
    elif isinstance(solver, diffrax.AbstractImplicitSolver) and not with_diffusion:
        _check_implicit(solver, where)
    elif tableau_of(solver) is None and not with_diffusion:
        raise ValueError(
            f"{where}: solver {type(solver).__name__} does not fit fixed steps of "
            "dx/dt = f(t, x, u, w). Use an explicit Runge-Kutta method "
            "(diffrax.Euler, Heun, Midpoint, Ralston, Bosh3, Tsit5, Dopri5, Dopri8, "
            "delucax.dynamics.RK4) or a diagonally implicit one "
            "(diffrax.ImplicitEuler, Kvaerno3, Kvaerno4, Kvaerno5)."
        )


def check_adaptive(solver: diffrax.AbstractSolver, where: str) -> None:
    """Raise unless `solver` has an error estimate for a step-size controller."""
    name = type(solver).__name__
    tableau = tableau_of(solver)
    no_error = tableau is not None and not tableau.b_error.any()
    # Checked here, because Diffrax accepts a tableau whose error weights are all zero.
    if no_error or not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        raise ValueError(
            f"{where}: solver {name} has no error estimate, which a "
            "stepsize_controller needs. Use diffrax.Tsit5(), or wrap it: "
            f"diffrax.HalfSolver({name}())."
        )
    if isinstance(solver, diffrax.AbstractImplicitSolver):
        _check_implicit(solver, where)


def _check_implicit(solver: diffrax.AbstractSolver, where: str) -> None:
    if solver.term_structure is not diffrax.AbstractTerm:
        raise ValueError(
            f"{where}: solver {type(solver).__name__} needs a split into stiff and "
            "non-stiff parts. Use diffrax.ImplicitEuler, Kvaerno3, Kvaerno4 or "
            "Kvaerno5."
        )
    if isinstance(solver, diffrax.AbstractWrappedSolver):
        raise ValueError(
            f"{where}: solver {type(solver).__name__} wraps an implicit solver and "
            "hides its root finder. Pass the inner solver itself."
        )


def solve_result(solution: diffrax.Solution, controller: Any, dtype: Any) -> Result:
    """The result of a solve; `controller` is its step-size controller or `None`.

    The result is `beyond_precision` if the solve reached its maximal number of steps
    with an `rtol` below the precision of the state.
    """
    result = promote(solution.result)
    if controller is None:
        return result
    # The error estimate is itself rounded, to about eps times the state. With a smaller
    # tolerance, steps shrink without end. Most tolerances are Python numbers far above
    # eps, so that nothing is compiled here.
    is_fine = controller.rtol < 4 * float(jnp.finfo(dtype).eps)
    if is_fine is False:
        return result
    blamed = is_fine & (result == RESULTS.max_steps_reached)
    return choose(blamed, RESULTS.beyond_precision, result)


def _forwarded(name: str) -> Any:
    return property(lambda self: getattr(self.solver, name))


class AbstractForwardingSolver(diffrax.AbstractWrappedSolver):
    """A wrapper that forwards attributes and methods to the solver inside."""

    solver: eqx.AbstractVar[diffrax.AbstractSolver]

    term_structure = _forwarded("term_structure")
    term_compatible_contr_kwargs = _forwarded("term_compatible_contr_kwargs")
    interpolation_cls = _forwarded("interpolation_cls")
    # A wrapper satisfies the instance checks after which Diffrax reads these.
    root_finder = _forwarded("root_finder")
    root_find_max_steps = _forwarded("root_find_max_steps")
    scan_kind = _forwarded("scan_kind")
    order = _forwarded("order")
    strong_order = _forwarded("strong_order")
    error_order = _forwarded("error_order")
    init = _forwarded("init")
    func = _forwarded("func")


class _Chord(diffrax.VeryChord):
    """Diffrax's chord method, iterated until convergence.

    Diffrax's own stops after two iterations and leaves it to the step-size controller
    to take a shorter step. Fixed steps have no such controller.
    """

    atol: Any  # one for each entry; Diffrax has one number for all entries

    def terminate(self, fn, y, args, options, state, tags):
        del fn, y, args, options, tags
        # The changes shrink by `rate`, so the distance to the root is the rest of a
        # geometric series (Hairer and Wanner, 1996, IV.8).
        size = state.diffsize  # of the last change, in units of the tolerance
        rate = size / state.diffsize_prev
        left = size * rate / (1 - rate)
        enough = state.step >= 2  # a rate needs two changes
        # Close to the root, rounding dominates and the rate is meaningless.
        converged = enough & ((size < 0.1) | (rate < 1) & (left < 0.01))
        diverged = enough & ~converged & (~jnp.isfinite(size) | (rate > 2))
        result = optx.RESULTS.where(
            diverged, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        failed = state.result != optx.RESULTS.successful
        result = optx.RESULTS.where(failed, state.result, result)
        return failed | converged | diverged, result


class _FixedStep(AbstractForwardingSolver):
    """An implicit solver that sets the tolerances of its root finder itself, without a
    step-size controller.

    The unknown is a slope, or its product with the step. In a stiff field, the rounding
    of the state alone makes slopes inaccurate. The tolerance is therefore relative to
    the state, not to the slope.
    """

    solver: diffrax.AbstractSolver

    @property
    def root_finder(self):
        return self._with_tolerances(1e-3, 1.0).root_finder

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        # Well above rounding, and far below the error of any sensible step.
        is_double = y0.dtype == jnp.float64
        rtol, atol = (1e-10, 1e-12) if is_double else (1e-5, 1e-6)
        # No gradient: a tolerance only decides how many iterations there are.
        scale = lax.stop_gradient(atol + rtol * jnp.abs(y0))
        solver: Any = self.solver
        if isinstance(self.solver, diffrax.AbstractDIRK) and solver.tableau.fsal:
            # Here Diffrax solves for the slope, elsewhere for its product with the
            # step.
            scale = scale / lax.stop_gradient(t1 - t0)
        solver = self._with_tolerances(rtol, scale)
        return solver.step(terms, t0, t1, y0, args, solver_state, made_jump)

    def _with_tolerances(self, rtol: float, atol: Any) -> Any:
        finder = self.solver.root_finder  # pyright: ignore
        # Tolerances that the user gave are kept.
        values = {"rtol": rtol, "atol": atol, "norm": optx.rms_norm}
        if isinstance(finder, diffrax.VeryChord | optx.Chord):
            finder = _Chord(**values, linear_solver=finder.linear_solver)
        for name in _unset(finder):
            get = operator.attrgetter(name)
            finder = eqx.tree_at(get, finder, values[name])
        return eqx.tree_at(lambda s: s.root_finder, self.solver, finder)


_Unset = type(diffrax.with_stepsize_controller_tols(optx.Newton)().rtol)
"""Diffrax's placeholder for a tolerance that a step-size controller sets. The class has
no public name."""


def _unset(finder: optx.AbstractRootFinder) -> list[str]:
    """The tolerances that a root finder leaves to a step-size controller."""
    names = ("rtol", "atol", "norm")
    return [name for name in names if isinstance(getattr(finder, name), _Unset)]


def as_fixed_step_solver(solver: Any) -> Any:
    """An implicit solver that works without a step-size controller and outside of
    `diffeqsolve`, in forward- and reverse-mode differentiation.
    """
    # `diffeqsolve` chooses the loop over the stages itself. Outside of it, the bounded
    # loop has a reverse mode.
    if isinstance(solver, diffrax.AbstractDIRK) and solver.scan_kind is None:
        is_none = lambda leaf: leaf is None
        solver = eqx.tree_at(lambda s: s.scan_kind, solver, "bounded", is_leaf=is_none)
    return _FixedStep(solver) if _unset(solver.root_finder) else solver


def throwing_adjoint(adjoint: diffrax.AbstractAdjoint) -> diffrax.AbstractAdjoint:
    """An adjoint that raises if its backward solve fails.

    The backward solve of `BacksolveAdjoint` inherits `throw` from the forward solve,
    which is false because that returns a status. A gradient cannot return one.
    """
    if not isinstance(adjoint, diffrax.BacksolveAdjoint):
        return adjoint
    return diffrax.BacksolveAdjoint(**({"throw": True} | adjoint.kwargs))
