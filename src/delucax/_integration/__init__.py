"""How vector fields are integrated: what `Discretized` and `simulate` share."""

from ._field import (
    check_returned as check_returned,
    evaluate_field as evaluate_field,
    Start as Start,
)
from ._runge_kutta import (
    RK4 as RK4,
    runge_kutta_step as runge_kutta_step,
    tableau_of as tableau_of,
)
from ._solvers import (
    AbstractTransparentSolver as AbstractTransparentSolver,
    check_adaptive as check_adaptive,
    check_kind as check_kind,
    check_method as check_method,
    for_fixed_steps as for_fixed_steps,
    raise_on_failure as raise_on_failure,
    solve_result as solve_result,
)
