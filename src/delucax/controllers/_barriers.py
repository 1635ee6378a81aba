"""Barrier conditions of a plant, and how a control changes them.

In continuous time, a barrier `b(t, x)` of relative degree one gives the condition
`db/dt + decay b >= 0`. A barrier of relative degree two gives the same condition for
`db/dt + decay b` in place of `b`. In discrete time, the change over a step replaces the
derivative.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._check import as_float_array, is_concrete
from .._jax import value_and_jacobians
from .._message import shortened
from .._module import check_function
from .._typing import Array
from ..dynamics import AbstractDynamics
from ..systems import AbstractPlant, AbstractSystem


_ROUNDING = 100.0
"""A derivative of up to this many units of rounding counts as zero."""
_SAMPLES = 16

Psi = Callable[[Array, Array], Array]


class Conditions(eqx.Module):
    """The barrier conditions of a plant."""

    plant: AbstractPlant
    functions: dict[str, Callable[..., Any]]
    decay: Array
    disturbance: Array | None
    degrees: tuple[int, ...] = eqx.field(static=True, default=())

    def flow(self, t: Array, x: Array, u: Array, w: Array | None) -> Array:
        """The time derivative of the state, or the next state."""
        plant: Any = self.plant
        if isinstance(plant, AbstractDynamics):
            return plant.advance(t, x, u, w)[0]
        return plant.vector_field(t, x, u, w)

    def no_disturbance(self, dtype: Any) -> Array | None:
        """A disturbance of zero, or `None` if the plant takes none."""
        if self.disturbance is None and not self.plant.disturbance_names:
            return None
        return jnp.zeros(self.plant.disturbance_size, dtype)

    def values(self, t: Array, x: Array) -> Array:
        """The values of all barriers, in one vector."""
        parts = [jnp.ravel(jnp.asarray(f(t, x))) for f in self.functions.values()]
        whole = parts[0] if len(parts) == 1 else jnp.concatenate(parts)
        return whole.astype(x.dtype)

    def along(self, psi: Psi, order: int) -> Callable[[Array, Array, Array], Array]:
        """The condition of `psi`: its least change along the plant, plus `decay psi`.

        The least change is the one under the worst disturbance.
        """
        decay = self.decay[:, order]

        def condition(t, x, u):
            rates = decay.astype(x.dtype)

            def under(w):
                arrived = self.flow(t, x, u, w)
                if isinstance(self.plant, AbstractDynamics):
                    now = psi(t, x)
                    later = psi(t + self.plant.dt.astype(x.dtype), arrived)
                    return later - now + rates * now
                moved = jnp.ones_like(t), arrived.astype(x.dtype)
                now, slope = jax.jvp(psi, (t, x), moved)
                return slope + rates * now

            no_disturbance = self.no_disturbance(x.dtype)
            if self.disturbance is None or no_disturbance is None:
                return under(no_disturbance)
            value, (E,) = value_and_jacobians(under, no_disturbance)
            bound = jnp.broadcast_to(
                self.disturbance.astype(x.dtype), no_disturbance.shape
            )
            return value - jnp.abs(E) @ bound

        return condition

    def first(self, t: Array, x: Array) -> Array:
        """The first-order condition of barriers of degree two, which has no control."""
        return self.along(self.values, 0)(t, x, jnp.zeros(self.control_size, x.dtype))

    @property
    def last_decay(self) -> Array:
        """The decay of the last order of each condition."""
        return self.decay[np.arange(len(self.degrees)), np.array(self.degrees) - 1]

    def last(self, t: Array, x: Array) -> Array:
        """The function that each condition keeps positive: `b` or `db/dt + decay b`."""
        values = self.values(t, x)
        if 2 not in self.degrees:
            return values
        return jnp.where(np.array(self.degrees) == 2, self.first(t, x), values)

    @property
    def control_size(self) -> int:
        """The number of controls."""
        return self.plant.control_size

    def __call__(self, t: Array, x: Array, u: Array) -> Array:
        """The conditions, each of the relative degree of its barrier."""
        if set(self.degrees) == {2}:
            return self.along(self.first, 1)(t, x, u)
        first = self.along(self.values, 0)(t, x, u)
        if 2 not in self.degrees:
            return first
        second = self.along(self.first, 1)(t, x, u)
        return jnp.where(np.array(self.degrees) == 2, second, first)


def check_plant(plant: Any, where: str) -> None:
    """Raise unless the plant is a system or dynamics, and has a control."""
    if not isinstance(plant, AbstractSystem | AbstractDynamics):
        raise ValueError(
            f"{where}: plant must be an AbstractSystem or an AbstractDynamics (for an "
            f"environment, pass its `dynamics`), got {type(plant).__name__}."
        )
    if plant.control_size == 0:
        raise ValueError(f"{where}: plant must have at least one control, got none.")


def sizes_of(
    functions: Mapping[str, Callable[..., Any]], state_size: int, where: str
) -> tuple[int | None, ...]:
    """The number of values that each barrier returns; `None` for a scalar."""
    dtype, sizes = jnp.result_type(float), []
    given = [jax.ShapeDtypeStruct(shape, dtype) for shape in ((), (state_size,))]
    for name, function in functions.items():
        check_function(function, f"barriers[{name!r}]", where, "t, x")
        try:
            like = eqx.filter_eval_shape(lambda *a, f=function: f(*a), *given)
        except (TypeError, IndexError) as error:
            raise ValueError(
                f"{where}: barriers[{name!r}] fails when it is called with (t, x), "
                f"with x of shape ({state_size},): {error}"
            ) from error
        shape = getattr(like, "shape", () if isinstance(like, int | float) else None)
        if shape is None or len(shape) > 1 or 0 in shape:
            raise ValueError(
                f"{where}: barriers[{name!r}] must return a number or a vector, got "
                f"{like}."
            )
        sizes.append(shape[0] if shape else None)
    return tuple(sizes)


def entry_names(names: Iterable[str], sizes: Iterable[int | None]) -> tuple[str, ...]:
    """A name for each value that the barriers return."""
    entries = []
    for name, size in zip(names, sizes, strict=True):
        each = [name] if size is None else [f"{name}[{i}]" for i in range(size)]
        entries += each
    return tuple(entries)


def by_entry(
    value: Any,
    name: str,
    like: tuple[int, ...],
    sizes: Mapping[str, int | None],
    default: float | None,
    where: str,
) -> Array:
    """A number, or an array of shape `like`, for each value of the barriers.

    It is given once for all barriers, or in a dictionary by the name of the barrier.
    """
    by_name = isinstance(value, Mapping)
    if by_name and (unknown := sorted(set(map(str, value)) - set(sizes))):
        raise ValueError(
            f"{where}: {name} must have the names of barriers as keys, "
            f"{sorted(sizes)}, got {unknown}."
        )
    rows = []
    for of, size in sizes.items():
        one = value.get(of, default) if by_name else value
        if one is None:
            raise ValueError(f"{where}: {name} must have a value for {of!r}, got none.")
        array = as_float_array(one)
        if not eqx.is_inexact_array(array) or array.shape not in ((), like):
            pair = " or a pair" if like else ""
            raise ValueError(
                f"{where}: {name} must be a number{pair}, or a dictionary of these by "
                f"the names of barriers, got {shortened(one)}."
            )
        rows += [array] * (size or 1)
    # So that concrete values stay concrete under a trace.
    with jax.ensure_compile_time_eval():
        return jnp.stack([jnp.broadcast_to(row, like) for row in rows])


def as_degrees(
    value: Any, sizes: Mapping[str, int | None], where: str
) -> tuple[int, ...]:
    """The given relative degrees, one for each value of the barriers."""
    given = np.asarray(by_entry(value, "degrees", (), sizes, None, where))
    if not np.all((given == 1) | (given == 2)):
        raise ValueError(f"{where}: degrees must be 1 or 2, got {value}.")
    return tuple(int(degree) for degree in given)


def sample_states(plant: AbstractPlant) -> np.ndarray:
    """States that fill a box of half-width 1 about the equilibrium, or about zero."""
    n = plant.state_size
    try:
        centre = np.asarray(plant.equilibrium()[0])
    except (ValueError, TypeError, jax.errors.JAXTypeError):
        centre = np.zeros(n)
    return centre + 2 * _scattered(_SAMPLES, n) - 1


def _scattered(count: int, size: int) -> np.ndarray:
    """Points that fill the unit cube evenly (Weyl, by square roots of primes)."""
    primes, candidate = [], 2
    while len(primes) < size:
        if all(candidate % prime for prime in primes):
            primes.append(candidate)
        candidate += 1
    return np.outer(np.arange(1, count + 1), np.sqrt(primes)) % 1


class _Traced(ValueError):
    """The plant or the barriers are traced, so nothing can be checked."""


def checked_degrees(
    plant: AbstractPlant,
    functions: dict[str, Callable[..., Any]],
    names: tuple[str, ...],
    states: Any,
    known: tuple[int, ...] | None,
    is_disturbed: bool,
    where: str,
) -> tuple[int, ...]:
    """The relative degrees of the barriers, after a check that a system is affine.

    The `known` degrees are compared with the computed ones, unless something is traced.
    """
    try:
        if isinstance(plant, AbstractSystem):
            check_affine(plant, states, is_disturbed, where)
        degrees = relative_degrees(plant, functions, names, states, where)
    except _Traced:
        if known is None:
            raise
        return known
    if known is None:
        return degrees
    for name, given, degree in zip(names, known, degrees, strict=True):
        if given != degree:
            raise ValueError(
                f"{where}: degrees must be {degree} for {name!r}, the first order at "
                f"which it sees the control, got {given}."
            )
    return known


def relative_degrees(
    plant: AbstractPlant,
    functions: dict[str, Callable[..., Any]],
    names: tuple[str, ...],
    states: Any,
    where: str,
) -> tuple[int, ...]:
    """The relative degree of each barrier, from its derivatives at sample states."""
    # Any decay gives the same degrees, and the given one may be traced.
    ones: Any = np.ones((len(names), 2))
    conditions = Conditions(plant, functions, ones, None)
    first, known = _at_samples(_sees_control, conditions, states, where, 0)
    if not np.all(known):
        raise ValueError(
            f"{where}: barriers must be finite at one of the sample states, but "
            f"{names[int(np.argmin(known))]!r} is not finite at any of them. Pass "
            "`states` at which it is."
        )
    degrees = np.where(first, 1, 2)
    if not np.all(first):
        second, _ = _at_samples(_sees_control, conditions, states, where, 1)
        if not np.all(first | second):
            name = names[int(np.argmin(first | second))]
            is_discrete = isinstance(plant, AbstractDynamics)
            when = "two steps later" if is_discrete else "in its second derivative"
            raise ValueError(
                f"{where}: barriers must see the control at relative degree 1 or 2, "
                f"but {name!r} does not at any sample state: the control has no effect "
                f"on it even {when}."
            )
    return tuple(int(degree) for degree in degrees)


def check_affine(
    plant: AbstractPlant, states: Any, is_disturbed: bool, where: str
) -> None:
    """Raise unless the field is affine in the control, and in a bounded disturbance."""
    none: Any = np.ones((0, 2))
    conditions = Conditions(plant, {}, none, None)
    for argument, with_disturbance in (("control", False), ("disturbance", True)):
        if with_disturbance and not is_disturbed:
            continue
        curved, known = _at_samples(
            _is_curved, conditions, states, where, with_disturbance
        )
        if not known:
            raise ValueError(
                f"{where}: plant must have a finite vector field at one of the sample "
                "states, but it has none. Pass `states` at which it is finite."
            )
        if curved:
            raise ValueError(
                f"{where}: plant must have a vector field that is affine in the "
                f"{argument}, such as f(t, x) + g(t, x) u, but the "
                f"field of {type(conditions.plant).__name__} is not. Discretise the "
                "plant: in discrete time the filter linearises."
            )


def _at_samples(test, conditions: Conditions, states: Any, where: str, option: Any):
    """Whether `test` holds at any of the states, and whether any decides it."""
    with jax.ensure_compile_time_eval():
        holds, known = _tested(test, conditions, jnp.asarray(states, float), option)
        if not is_concrete(holds):
            raise _Traced(
                f"{where}: degrees must be given if plant or barriers are traced."
            )
    holds, known = np.asarray(holds), np.asarray(known)
    return np.any(holds & known, 0), np.any(known, 0)


@eqx.filter_jit
def _tested(test, conditions, states, option):
    t = jnp.zeros((), states.dtype)
    return jax.vmap(lambda x: test(conditions, t, x, option))(states)


def _sees_control(conditions: Conditions, t: Array, x: Array, order: int):
    """Whether the derivative of `order` depends on the control, beyond rounding."""
    psi = conditions.first if order else conditions.values
    u = jnp.zeros(conditions.control_size, x.dtype)
    A = jax.jacfwd(conditions.along(psi, order), 2)(t, x, u)
    flow = lambda u: conditions.flow(t, x, u, conditions.no_disturbance(x.dtype))
    moved, g = flow(u), jax.jacfwd(flow)(u)
    place = moved if isinstance(conditions.plant, AbstractDynamics) else x
    slope = jax.jacfwd(psi, 1)(t, place)
    least = _ROUNDING * jnp.finfo(x.dtype).eps * (jnp.abs(slope) @ jnp.abs(g))
    known = jnp.all(jnp.isfinite(A), 1) & jnp.isfinite(psi(t, x))
    return jnp.any(jnp.abs(A) > least, 1), known


def _is_curved(conditions: Conditions, t: Array, x: Array, with_disturbance: bool):
    """Whether the field at a sum of inputs is not the sum of the fields."""
    m = conditions.control_size
    k = conditions.plant.disturbance_size if with_disturbance else 0
    one, two = jnp.asarray(4 * _scattered(2, m + k) - 2, x.dtype)
    no_disturbance = conditions.no_disturbance(x.dtype)

    def field(z):
        w = z[m:] if with_disturbance else no_disturbance
        return conditions.flow(t, x, z[:m], w)

    terms = [field(one + two), field(jnp.zeros_like(one)), -field(one), -field(two)]
    size = sum(map(jnp.abs, terms))
    off = jnp.abs(sum(terms)) > _ROUNDING * jnp.finfo(x.dtype).eps * size
    return jnp.any(off), jnp.all(jnp.isfinite(size))
