"""Kinds of fields: physical constants, trainable weights, functions."""

import abc
import dataclasses
import inspect
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import AbstractArray, Array, jaxtyped

from .._host import on_host
from .._message import shortened


_ROLE = "delucax_role"
_CONSTRAINT = "delucax_constraint"
_FUNCTION = "delucax_function"


class AbstractConstraint(eqx.Module):
    """A set of valid values, with a smooth bijection from the real numbers to it.

    Training changes an unconstrained value, and the model gets the constrained one. So
    no step of any optimiser can leave the set.
    """

    @abc.abstractmethod
    def constrain(self, z: Array) -> Array:
        """The valid value that belongs to an unconstrained number `z`."""

    @abc.abstractmethod
    def unconstrain(self, value: Array) -> Array:
        """The unconstrained number `z` for which `constrain(z)` equals `value`."""

    @abc.abstractmethod
    def holds(self, value: Array) -> Array:
        """Whether each entry of `value` is valid."""


class _Positive(AbstractConstraint):
    """The constraint that values are above zero. Training changes the logarithm of a
    value instead of the value itself, so that training steps are relative changes.

    !!! example

        ```python
        import delucax as dlx

        length = dlx.parameter(1.0, constraint=dlx.positive)
        ```
    """

    def constrain(self, z: Array) -> Array:
        return _strictly_inside(jnp.exp(z), 0.0, np.inf)

    def unconstrain(self, value: Array) -> Array:
        return jnp.log(value)

    def holds(self, value):
        return value > 0

    def __repr__(self):
        return "positive"


def _strictly_inside(value: Array, low: float, high: float) -> Array:
    """`value`, moved off the ends of an open interval, where rounding may put it."""
    # Far out, exp and the sigmoid round to the ends. There the logarithm in
    # `unconstrain` is infinite, and the gradient would stay zero.
    dtype = jnp.result_type(value)
    tiny, ends = jnp.finfo(dtype).tiny, np.asarray([low, high], dtype)
    inner = np.nextafter(ends, ends[::-1])
    # XLA flushes subnormal numbers to zero.
    inner = np.where(np.abs(inner) < tiny, np.copysign(tiny, inner), inner)
    return jnp.clip(value, *map(float, inner))


positive = _Positive()
"""The constraint that values are above zero."""


class bounded(AbstractConstraint):
    r"""The constraint $\mathrm{low} < x < \mathrm{high}$ of a [`delucax.parameter`][]
    or [`delucax.weight`][].

    Training changes the logit of the value instead of the value itself, so that no
    training step can leave the interval.

    **Arguments:**

    - `low`: the lower end, a finite number.
    - `high`: the upper end, a finite number above `low`.

    **Raises:** `ValueError` if `low` is not below `high`, or an end is not finite.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from jaxtyping import Array

        class Decay(dlx.AbstractSystem):
            state_names, control_names = ("x",), ("u",)
            rate: Array = dlx.parameter(0.1, constraint=dlx.bounded(0.0, 1.0))

            def vector_field(self, t, x, u, w):
                return u - self.rate * x

        Decay(rate=0.5).vector_field(0.0, jnp.ones(1), jnp.zeros(1), None)
        ```

        ```text
        Array([-0.5], dtype=float32)
        ```
    """

    low: float = eqx.field(converter=float)
    high: float = eqx.field(converter=float)

    def __check_init__(self):
        low, high = self.low, self.high
        if not low < high:
            raise ValueError(f"bounded: low must be below high, got {low} and {high}.")
        if not np.all(np.isfinite([low, high])):
            raise ValueError(
                f"bounded: low and high must be finite, got {low} and {high}. For "
                "values above zero without an upper end, use delucax.positive."
            )

    def constrain(self, z: Array) -> Array:
        value = self.low + (self.high - self.low) * jax.nn.sigmoid(z)
        return _strictly_inside(value, self.low, self.high)

    def unconstrain(self, value: Array) -> Array:
        return jnp.log(value - self.low) - jnp.log(self.high - value)

    def holds(self, value):
        return (value > self.low) & (value < self.high)

    def __repr__(self):
        return f"bounded({self.low}, {self.high})"


def as_float_array(value: Any) -> Any:
    """A number as a weakly typed float array; anything else unchanged.

    A weakly typed number takes the precision of the arrays that it is combined with, so
    one module serves float32 and float64. Integers become floats. Arrays of numbers
    keep their precision.
    """
    if on_host():
        return _as_host_array(value)
    if value is None or isinstance(value, jax.Array) and eqx.is_inexact_array(value):
        return value
    if isinstance(value, bool | int | float | np.number) or (
        isinstance(value, np.ndarray) and value.ndim == 0
    ):
        # From a Python number, because a NumPy array would give a strong type. Not by
        # `jnp.asarray`, which would compile a program. The number is known even while
        # something else is traced.
        with jax.ensure_compile_time_eval():
            return jax.device_put(float(value))
    if isinstance(value, np.ndarray | list | tuple | jax.Array):
        try:
            array = _as_array(value)
        except (TypeError, ValueError):  # ragged, or not numbers
            return value
        return array if eqx.is_inexact_array(array) else array.astype(float)
    return value


def _as_array(value: Any) -> Array:
    """`jnp.asarray(value)`, without compiling a program for each shape."""
    leaves = jax.tree.leaves(value, is_leaf=lambda leaf: leaf is None)
    if isinstance(value, jax.Array) or any(isinstance(leaf, Tracer) for leaf in leaves):
        return jnp.asarray(value)
    # NumPy would take None for NaN, and a string for the name of a dtype.
    if any(leaf is None or isinstance(leaf, str) for leaf in leaves):
        raise TypeError
    dtype = jnp.result_type(float, *leaves)
    # A copy, because JAX may share the memory of an array that the user changes later.
    return jax.device_put(np.array(value, dtype))


def _as_host_array(value: Any) -> Any:
    """Numbers as a NumPy array, in the precision that JAX would give them."""
    if value is None:
        return value
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        return value
    if array.dtype.kind not in "biufc":
        return value
    dtype = array.dtype if array.dtype.kind in "fc" else float
    return array.astype(jax.dtypes.canonicalize_dtype(dtype), copy=False)


def parameter(
    default: Any = dataclasses.MISSING, *, constraint: AbstractConstraint | None = None
) -> Any:
    """Declare a field that holds a physical constant.

    If the value of the field is a number, delucax converts it to a floating-point
    array. You can differentiate with respect to this array, batch it under `jax.vmap`,
    and change its value without compiling again. A plain `float` field would be static
    under `eqx.filter_jit`: JAX would compile again for each new value, and the gradient
    of the field would be `None`.

    **Arguments:**

    - `default`: the default value, a number or an array. Without it, the field is
        required.
    - `constraint`: the valid values, [`delucax.positive`][] or a [`delucax.bounded`][];
        none by default. delucax checks the constraint when a module is constructed, and
        [`delucax.training.fit`][] never violates the constraint.

    **Returns:** a dataclass field.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from jaxtyping import Array

        class Oscillator(dlx.AbstractSystem):
            state_names = ("x", "v")
            control_names = ("force",)
            stiffness: Array = dlx.parameter(1.0, constraint=dlx.positive)

            def vector_field(self, t, x, u, w):
                return jnp.stack([x[1], u[0] - self.stiffness * x[0]])

        Oscillator(stiffness=4.0).stiffness
        ```

        ```text
        Array(4., dtype=float32, weak_type=True)
        ```
    """
    return _field("parameter", default, constraint)


def weight(
    default: Any = dataclasses.MISSING, *, constraint: AbstractConstraint | None = None
) -> Any:
    """Declare a field that holds trainable weights: an array, a number, or a network.

    By default, `delucax.training.fit` trains only the fields that are declared with
    `weight`.

    **Arguments:**

    - `default`: the default value. Without it, the field is required.
    - `constraint`: the valid values, as in [`delucax.parameter`][]; none by default.

    **Returns:** a dataclass field.

    !!! example

        ```python
        import delucax as dlx
        from jaxtyping import Array

        class Proportional(dlx.AbstractController):
            gain: Array = dlx.weight(1.0)

            def __call__(self, t, y, state):
                return -self.gain * y[:1], state

        Proportional().gain
        ```

        ```text
        Array(1., dtype=float32, weak_type=True)
        ```
    """
    return _field("weight", default, constraint)


def _field(role: str, default: Any, constraint: AbstractConstraint | None) -> Any:
    given: dict[str, Any] = {"default": default}
    if isinstance(default, list | np.ndarray | jax.Array):
        # A dataclass takes a mutable or unhashable default only from a function.
        given = {"default_factory": lambda: default}
    metadata = {_ROLE: role, _CONSTRAINT: constraint}
    return eqx.field(**given, converter=_as_value, metadata=metadata)


def _as_value(value: Any) -> Any:
    return as_module(value) if callable(value) else as_float_array(value)


class StaticFunction(eqx.Module):
    """A plain function as a module without leaves.

    `jax.jit` refuses a module with a function among its leaves. In this wrapper the
    function is part of the structure.
    """

    function: Callable = eqx.field(static=True)

    def __call__(self, *args, **kwargs):
        return self.function(*args, **kwargs)

    def __repr__(self):
        return repr(self.function)


def as_module(value: Any) -> Any:
    """A plain function as a `StaticFunction`; anything else unchanged."""
    is_plain = callable(value) and jax.tree_util.all_leaves([value])
    return StaticFunction(value) if is_plain else value


def function_field(default: Any = dataclasses.MISSING, *, of: str | None = None) -> Any:
    """A field that holds a function: a plain one, or a module with a `__call__`. `of`
    names its arguments, as in "t, x", if they are always the same."""
    return eqx.field(default=default, converter=as_module, metadata={_FUNCTION: of})


def fields_of(node: Any) -> dict[str, dataclasses.Field]:
    """The fields of a module or another dataclass, by name; none for other nodes."""
    fields = dataclasses.fields(node) if dataclasses.is_dataclass(node) else ()
    return {field.name: field for field in fields}


def children_of(node: Any) -> dict[str, Any]:
    """The children of a node, by the names that they have in paths."""
    if isinstance(node, Mapping):
        return {str(key): child for key, child in node.items()}
    if isinstance(node, tuple | list) and not hasattr(node, "_fields"):
        return {str(i): child for i, child in enumerate(node)}
    names = fields_of(node) or getattr(node, "_fields", ())
    return {name: getattr(node, name, None) for name in names}


_Part = TypeVar("_Part", bound=eqx.Module)


def parts_of(module: Any, kind: type[_Part]) -> list[_Part]:
    """The modules of class `kind` inside of a module or pytree. Modules inside of these
    are left out."""
    is_part = lambda node: isinstance(node, kind) and node is not module
    nodes = jax.tree.leaves(module, is_leaf=is_part)
    return [node for node in nodes if is_part(node)]


def marked_leaves(
    tree: Any,
) -> Iterator[tuple[tuple, Any, str | None, AbstractConstraint | None]]:
    """`(path, leaf, role, constraint)` of every leaf. The innermost `parameter()` or
    `weight()` field on its path declares the role and the constraint."""
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        node, role, constraint = tree, None, None
        for key in path:
            name, children = path_string((key,)), children_of(node)
            if name not in children:  # inside a node that only JAX can flatten
                break
            if name in (fields := fields_of(node)):
                role = fields[name].metadata.get(_ROLE, role)
                constraint = fields[name].metadata.get(_CONSTRAINT, constraint)
            node = children[name]
        yield path, leaf, role, constraint


def path_string(path: tuple) -> str:
    """A JAX key path in the form that [`delucax.replace`][] takes."""
    return jax.tree_util.keystr(path, simple=True, separator=".")


def check_parameters(module: eqx.Module) -> None:
    """Raise unless every `parameter()`, `weight()` and function of `module` is valid.

    Traced values are not inspected.
    """
    for field in dataclasses.fields(module):
        value = getattr(module, field.name, None)
        name = f"{type(module).__name__}: {field.name}"
        if _FUNCTION in field.metadata and value is not None:
            of = field.metadata[_FUNCTION]
            check_function(value, field.name, type(module).__name__, of)
        if _ROLE in field.metadata:
            _check_numbers(value, name, field)


def check_function(value: Any, name: str, where: str, of: str | None = None) -> None:
    """Raise unless `value` is a function, which can be called with the arguments `of`,
    such as "t, x"."""
    rule = f"{where}: {name} must be a function{'' if of is None else f' of ({of})'}"
    if not callable(value):
        raise ValueError(f"{rule}, got {shortened(value)}.")
    inner: Any = value.function if isinstance(value, StaticFunction) else value
    if isinstance(inner, type):
        raise ValueError(
            f"{rule}, got the class {inner.__name__}. You may mean an instance, "
            f"{inner.__name__}(...)."
        )
    if of is None:
        return
    try:
        signature = inspect.signature(inner)
    except (TypeError, ValueError):  # of some functions in C it is not known
        return
    try:
        signature.bind(*of.split(", "))
    except TypeError:
        taken = ", ".join(map(str, signature.parameters))
        called = getattr(inner, "__name__", type(inner).__name__)
        raise ValueError(f"{rule}, got {called}, a function of ({taken}).") from None


def _check_numbers(value: Any, name: str, field: dataclasses.Field) -> None:
    constraint = field.metadata[_CONSTRAINT]
    is_missing = value is None and field.default not in (dataclasses.MISSING, None)
    for leaf in [None] if is_missing else jax.tree.leaves(value):
        is_number = eqx.is_inexact_array(leaf)
        # The other leaves of a network may be anything.
        is_alone = leaf is value or field.metadata[_ROLE] == "parameter"
        if is_alone and not (callable(leaf) or is_number):
            raise ValueError(
                f"{name} must be a number or an array, got {shortened(leaf)}."
            )
        if isinstance(leaf, Tracer) or not is_number:
            continue
        leaf = np.asarray(leaf)
        if not np.all(np.isfinite(leaf)):
            raise ValueError(f"{name} must be finite, got {shortened(leaf)}.")
        if constraint is not None and not np.all(constraint.holds(leaf)):
            raise ValueError(f"{name} must be {constraint}, got {shortened(leaf)}.")


def check_module(module: eqx.Module) -> None:
    """Raise unless the constructor could have made `module`.

    This checks its parameters, runs its `__check_init__`, and checks the shapes in the
    annotations of its fields.
    """
    check_parameters(module)
    for cls in type(module).__mro__:
        if "__check_init__" in cls.__dict__:
            cls.__dict__["__check_init__"](module)
    _check_shapes(module)


def _check_shapes(module: eqx.Module) -> None:
    """Raise unless a size that several annotations name, such as `n`, is the same."""
    shapes = []
    with jaxtyped("context"):
        fields = [(field, _hints(field)) for field in dataclasses.fields(module)]
        # A sum such as T+1 comes last, because it is known only if T is.
        fields.sort(key=lambda pair: any("+" in hint.dim_str for hint in pair[1]))
        for field, hints in fields:
            value: Any = getattr(module, field.name, None)
            if not hints or not eqx.is_inexact_array(value):
                continue
            dims = " or ".join(f"({', '.join(h.dim_str.split())})" for h in hints)
            shapes.append(f"{field.name} of shape {dims} is {value.shape}")
            if not any(isinstance(value, hint) for hint in hints):
                raise ValueError(
                    f"{type(module).__name__}: shapes must fit each other, got "
                    f"{'; '.join(shapes)}."
                )


def _hints(field: dataclasses.Field) -> list[Any]:
    """The jaxtyping annotations of a field."""
    hints = typing.get_args(field.type) or (field.type,)
    return [h for h in hints if isinstance(h, type) and issubclass(h, AbstractArray)]
