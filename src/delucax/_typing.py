"""Array aliases shared by every signature."""

from collections.abc import Callable
from typing import Any, Generic, Literal, TYPE_CHECKING, TypeAlias, TypeVar

from jaxtyping import ArrayLike, Bool, Float, Key, Num, UInt32


if TYPE_CHECKING:
    from jaxtyping import Array
else:
    # Any, because on the host it is a NumPy array.
    Array = Any


Numbers: TypeAlias = ArrayLike | list[Any] | tuple[Any, ...]
"""Anything that becomes an array: an array, a number, or nested lists of numbers."""
RealScalar: TypeAlias = Num[Array, ""] | int | float
"""A real number: a Python number or a rank-0 array."""
Time: TypeAlias = RealScalar
Vector: TypeAlias = Float[Array, "_"]  # noqa: F821
"""A rank-1 floating-point array."""
Matrix: TypeAlias = Float[Array, "_ _"]
"""A rank-2 floating-point array."""
Square: TypeAlias = Float[Array, "n n"]
"""A square matrix. All in one signature have the same size."""
State: TypeAlias = Float[Array, "states"]  # noqa: F821
Control: TypeAlias = Float[Array, "controls"]  # noqa: F821
Disturbance: TypeAlias = Float[Array, "disturbances"] | None  # noqa: F821
Observation: TypeAlias = Float[Array, "observations"]  # noqa: F821
Scalar: TypeAlias = Float[Array, ""]
Bounds: TypeAlias = tuple[Float[Array, "..."], Float[Array, "..."]]
"""`(low, high)`, each a number or an array with one number for each entry."""
BoolScalar: TypeAlias = Bool[Array, ""]
PRNGKey: TypeAlias = Key[Array, "..."] | UInt32[Array, "... 2"]
"""A key from `jax.random.key` (or the older `jax.random.PRNGKey`)."""
Difference: TypeAlias = Callable[[Array, Array], Array]
"""A function `(x, x_ref) -> deviation`, such as `system.difference`, which wraps
angles."""
Checkpoint: TypeAlias = Literal["step", "sqrt"] | None
"""What the gradient of a rollout stores."""


if TYPE_CHECKING:
    _Read = TypeVar("_Read")
    _Given = TypeVar("_Given")

    class _Converted(Generic[_Read, _Given]):
        """A field whose type differs from that of the constructor's argument.

        A static checker takes the type of the argument from `__set__`.
        """

        def __get__(self, instance: Any, owner: Any = None) -> _Read: ...
        def __set__(self, instance: Any, value: _Given) -> None: ...

    Real: TypeAlias = _Converted[Array, Numbers]
    RealOrNone: TypeAlias = _Converted[Array | None, Numbers | None]
    BoundsOrNone: TypeAlias = _Converted[
        Bounds | None, tuple[ArrayLike, ArrayLike] | None
    ]
else:
    Real, RealOrNone, BoundsOrNone = Array, Array | None, Bounds | None
