"""Count the evaluations of dynamics at run time, by host callbacks."""

from collections.abc import Callable
from queue import SimpleQueue
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from .._check import check_function, check_instance
from .._results import Result
from .._typing import RealScalar
from ..dynamics import AbstractDynamics, AbstractWrapper


class Evaluations(NamedTuple):
    """The number of calls of dynamics (`primal`), and of products with their Jacobian
    (`tangent`) and its transpose (`cotangent`)."""

    primal: int
    tangent: int
    cotangent: int


def count_evaluations(
    function: Callable[[AbstractDynamics], Any], dynamics: AbstractDynamics
) -> tuple[Any, Evaluations]:
    """Run a function of the dynamics, and count how often it evaluates the dynamics.

    `count_evaluations` calls the function with dynamics that count their evaluations
    while the program runs. The count is therefore exact in compiled loops too. Under
    `jax.vmap` the evaluations of all members of the batch are counted. Evaluations that
    XLA removes as dead code are not counted.

    Do not use `count_evaluations` to measure time: each report takes microseconds, and
    each call compiles again.

    **Arguments:**

    - `function`: a function that takes the dynamics as its argument, for example to
        call a planner.
    - `dynamics`: the dynamics, a [`delucax.AbstractDynamics`][].

    **Returns:** `(out, evaluations)`: `out` is what the function returns, and
    `evaluations` a named tuple of whole numbers:

    - `primal`: calls of the dynamics. The evaluation of the dynamics that a derivative
        needs also counts as one call.
    - `tangent`: products of the Jacobian of the dynamics with a vector.
    - `cotangent`: products of the transposed Jacobian of the dynamics with a vector.

    **Raises:** `ValueError` if `dynamics` is not an `AbstractDynamics`, or `function`
    is not a function.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        env = dlx.make("pendulum")
        x0, start = jnp.array([0.5, 0.0]), jnp.zeros((10, 1))
        plan, evaluations = dlx.planning.count_evaluations(
            lambda dynamics: dlx.planning.ilqr(dynamics, env.cost, x0, start),
            env.dynamics,
        )
        evaluations
        ```
    """
    where = "count_evaluations"
    check_instance(dynamics, AbstractDynamics, "dynamics", where)
    check_function(function, "function", where, "dynamics")
    reports: SimpleQueue[tuple[str, int]] = SimpleQueue()
    out = function(_Counted(dynamics, reports))
    jax.block_until_ready(eqx.filter(out, eqx.is_array))
    # Callbacks may still be running when the arrays are ready.
    jax.effects_barrier()
    counts = dict.fromkeys(Evaluations._fields, 0)
    while not reports.empty():
        kind, lanes = reports.get()
        counts[kind] += lanes
    return out, Evaluations(**counts)


class _Counted(AbstractWrapper):
    """Dynamics that report each evaluation."""

    dynamics: AbstractDynamics
    # A queue, because compiled code reports from any thread.
    reports: SimpleQueue[tuple[str, int]] = eqx.field(static=True)

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        x_next, result = self.dynamics.advance(t, x, u, w)
        here = dict(reports=self.reports, kind="primal", lanes=1)
        return _report.bind(x_next, jax.lax.stop_gradient(x_next), **here), result


_report = Primitive("report")
"""`report(x, where)` returns `x` and reports one evaluation. `where` is the value of
the dynamics at this point, so that a derivative is batched and repeated like the value.

Each transformation has its own report, so that an evaluation counts only if it is run.
"""


def _called(x: Any, where: Any, *, reports: Any, kind: str, lanes: int) -> Array:
    def count(flag):
        del flag
        reports.put((kind, lanes))
        return np.zeros((), bool)

    # Only booleans go to the host and back, because the thread of the callback may use
    # another precision.
    flag = jnp.any(x > 0) | jnp.any(where > 0)
    wrong = jax.pure_callback(count, jax.ShapeDtypeStruct((), jnp.bool), flag)
    return jnp.where(wrong, jnp.nan, x)


def _batch(values, dims, *, lanes, **params):
    # Under `jax.vmap` one report counts for all members of the batch.
    size = next(v.shape[d] for v, d in zip(values, dims, strict=True) if d is not None)
    x = batching.bdim_at_front(values[0], dims[0], size)
    return _report.bind(x, values[1], lanes=lanes * size, **params), 0


def _jvp(primals, tangents, **params):
    out = _report.bind(*primals, **params)
    if type(tangents[0]) is ad.Zero:
        return out, tangents[0]
    tangent = _report.bind(tangents[0], out, **(params | {"kind": "tangent"}))
    return out, tangent


def _transpose(cotangent, x, where, **params):
    del x
    if type(cotangent) is ad.Zero:
        return cotangent, None
    return _report.bind(cotangent, where, **(params | {"kind": "cotangent"})), None


_report.def_impl(_called)
_report.def_abstract_eval(lambda x, where, **params: x)
batching.primitive_batchers[_report] = _batch
ad.primitive_jvps[_report] = _jvp
ad.primitive_transposes[_report] = _transpose
mlir.register_lowering(_report, mlir.lower_fun(_called, multiple_results=False))
