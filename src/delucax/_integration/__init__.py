"""Runge-Kutta steps, Diffrax solvers and events, as `Discretized` and `simulate` use
them."""

from ._events import (
    any_of as any_of,
    Crossings as Crossings,
    crossings as crossings,
    locate as locate,
    pick as pick,
)
from ._field import (
    check_returned as check_returned,
    evaluate_field as evaluate_field,
    TimeOffset as TimeOffset,
)
from ._runge_kutta import (
    RK4 as RK4,
    runge_kutta_step as runge_kutta_step,
    runge_kutta_step_in_loop as runge_kutta_step_in_loop,
    tableau_of as tableau_of,
)
from ._solvers import (
    AbstractForwardingSolver as AbstractForwardingSolver,
    as_fixed_step_solver as as_fixed_step_solver,
    check_adaptive as check_adaptive,
    check_kind as check_kind,
    check_method as check_method,
    solve_result as solve_result,
    throwing_adjoint as throwing_adjoint,
)
