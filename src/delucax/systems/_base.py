"""The base classes of plants: `AbstractPlant`, and `AbstractSystem` in continuous
time."""

import abc
from typing import Any, ClassVar, Literal, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._check_models import output_of
from .._module import check_parameters, shown
from .._typing import Control, Disturbance, Observation, State, Time
from ..math import wrap


Noise = Literal["additive", "brownian"] | None


class AbstractPlant(eqx.Module):
    """The common base of systems and dynamics: the names and sizes of a plant, its
    sensor and its equilibrium.

    You rarely subclass `AbstractPlant` directly. Its subclass
    [`delucax.AbstractSystem`][] adds a vector field, and its subclass
    [`delucax.AbstractDynamics`][] adds a step in discrete time.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp

        plant = dlx.systems.Pendulum()
        assert isinstance(plant, dlx.systems.AbstractPlant)
        x, u = plant.equilibrium()
        plant.difference(jnp.array([6.3, 0.0]), x)
        ```

        ```text
        Array([0.017, 0.   ], dtype=float32)
        ```
    """

    if TYPE_CHECKING:  # a static checker would ask for abstract fields as arguments
        state_names: ClassVar[Any]
        control_names: ClassVar[Any]
    else:
        state_names: eqx.AbstractVar[tuple[str, ...]]
        control_names: eqx.AbstractVar[tuple[str, ...]]
    angle_names: ClassVar[Any] = ()
    disturbance_names: ClassVar[Any] = ()
    state_units: ClassVar[Any] = ()
    control_units: ClassVar[Any] = ()
    time_unit: ClassVar[Any] = "s"

    __repr__ = shown

    @property
    def state_size(self) -> int:
        """The number of states."""
        return len(self.state_names)

    @property
    def control_size(self) -> int:
        """The number of controls."""
        return len(self.control_names)

    @property
    def disturbance_size(self) -> int:
        """The size of the disturbance `w`: the number of `disturbance_names`, or the
        number of states if there are no names."""
        return len(self.disturbance_names) or self.state_size

    @property
    def noise(self) -> Noise:
        """How the disturbance `w` acts on the plant.

        - `None`: the disturbance enters the equations. This is the default for a plant
            with `disturbance_names`.
        - `"additive"`: the disturbance is added to the next state. This is the default
            for a plant without `disturbance_names`.
        - `"brownian"`: the disturbance holds the increments of Brownian motions.
        """
        return None if self.disturbance_names else "additive"

    @classmethod
    def declares_noise(cls) -> bool:
        """Whether the class overrides `noise`."""
        return cls.noise is not AbstractPlant.noise

    @property
    def observation_size(self) -> int:
        """The size of the observation that `observe` returns."""
        y = output_of(self.observe, (), (self.state_size,))
        is_array = isinstance(y, jax.ShapeDtypeStruct)
        if not is_array or len(y.shape) != 1:
            got = f"an array of shape {y.shape}" if is_array else type(y).__name__
            raise ValueError(
                f"{type(self).__name__}: observe must return a vector, got {got}."
            )
        return y.shape[0]

    @property
    def observes_state(self) -> bool:
        """Whether `observe` returns the state itself, which is found out by tracing
        `observe`."""
        shapes = (), (self.state_size,)
        t, x = (jax.ShapeDtypeStruct(s, jnp.result_type(float)) for s in shapes)
        traced = jax.make_jaxpr(self.observe)(t, x).jaxpr
        return list(traced.outvars) == [traced.invars[1]]

    def observe(self, t: Time, x: State) -> Observation:
        """The reading of the plant's sensor; the state by default.

        **Arguments:** `t`: time, a scalar. `x`: state, shape `(state_size,)`.

        **Returns:** the observation, a vector.
        """
        del t
        return x

    def difference(self, x: State, x_ref: State) -> State:
        """The deviation of `x` from `x_ref`: by default `x - x_ref`, where the
        differences of the states in `angle_names` are wrapped to +-pi.

        **Arguments:** `x`: state, shape `(state_size,)`. `x_ref`: the state to measure
            from, of the same shape.

        **Returns:** the deviation, a vector.
        """
        d = x - x_ref
        if not self.angle_names:
            return d
        angles = [name in self.angle_names for name in self.state_names]
        return jnp.stack([wrap(d[i]) if a else d[i] for i, a in enumerate(angles)])

    def equilibrium(self) -> tuple[State, Control]:
        """A state and a control at which the plant rests.

        **Returns:** `(x, u)`, shapes `(state_size,)` and `(control_size,)`.

        **Raises:** `ValueError` if the class defines no equilibrium, which is the
        default.
        """
        raise ValueError(
            f"{type(self).__name__} defines no equilibrium: override `equilibrium`, or "
            "pass both the state and the control. `delucax.trim` computes such a point "
            "from a guess of both."
        )


def check_names(plant: AbstractPlant) -> None:
    """Raise unless the names of a plant are tuples of different names, and its angles
    are states."""
    where = type(plant).__name__
    for kind in ("state", "angle", "control", "disturbance"):
        names = getattr(plant, f"{kind}_names")
        if isinstance(names, str) or not isinstance(names, tuple | list):
            raise ValueError(
                f"{where}: {kind}_names must be a tuple of strings, such as "
                f"('angle', 'velocity'), got {names!r}."
            )
        if len(set(names)) < len(names):
            raise ValueError(f"{where}: {kind}_names must differ, got {names}.")
    if not plant.state_names:
        raise ValueError(f"{where}: state_names must not be empty.")
    if not set(plant.angle_names) <= set(plant.state_names):
        raise ValueError(
            f"{where}: angle_names must be among state_names, "
            f"{plant.state_names}, got {plant.angle_names}."
        )


class AbstractSystem(AbstractPlant):
    r"""A system in continuous time, $\dot x = f(t, x, u, w)$.

    To define your own system, subclass `AbstractSystem`, name the states and controls,
    and write `vector_field`. States, controls and disturbances are vectors. The names
    determine the sizes of these vectors.

    **Class attributes** (or properties, if they depend on a field):

    - `state_names`, `control_names`: tuples of strings.
    - `angle_names`: the names of the states that are angles; none by default. The
        method `difference` wraps the differences of these angles to +-pi.
    - `disturbance_names`: a tuple of strings, empty by default. If you name
        disturbances, the disturbance `w` is an input of the vector field and is held
        constant over a step. If you name none, `w` has the size of the state, and the
        discrete-time dynamics add `w` to the next state.
    - `state_units`, `control_units`: tuples of strings, empty by default.
    - `time_unit`: a string, `"s"` by default.

    **Hooks:** you may override `observe`, `project`, `difference`, `equilibrium` and
    `diffusion`. Do not override the other methods.

    **Raises:** `ValueError` at construction if a [`delucax.parameter`][] is not finite
    or violates its constraint, or if the names are missing.

    !!! example

        ```python
        import delucax as dlx
        import jax.numpy as jnp
        from jaxtyping import Array

        class VanDerPol(dlx.AbstractSystem):
            state_names = ("x", "v")
            control_names = ("u",)
            mu: Array = dlx.parameter(1.0)

            def vector_field(self, t, x, u, w):
                acceleration = self.mu * (1 - x[0] ** 2) * x[1] - x[0] + u[0]
                return jnp.stack([x[1], acceleration])

        VanDerPol().vector_field(0.0, jnp.ones(2), jnp.zeros(1), None)
        ```

        ```text
        Array([ 1., -1.], dtype=float32)
        ```
    """

    def __check_init__(self):
        check_names(self)
        check_parameters(self)

    @classmethod
    def declares_noise(cls) -> bool:
        """Whether the class overrides `noise` or `diffusion`."""
        own_diffusion = cls.diffusion is not AbstractSystem.diffusion
        return own_diffusion or cls.noise is not AbstractSystem.noise

    @property
    def projects_state(self) -> bool:
        """Whether the class overrides `project`."""
        return type(self).project is not AbstractSystem.project

    @property
    def noise(self) -> Noise:
        """How the disturbance `w` acts: `"brownian"` if the system has a `diffusion`,
        else `None` if it has `disturbance_names`, else `"additive"`."""
        return super().noise if _brownian_size(self) is None else "brownian"

    @property
    def disturbance_size(self) -> int:
        """The size of the disturbance `w`: the number of Brownian motions if the system
        has a `diffusion`, else the number of `disturbance_names` if there are any, else
        the number of states."""
        motions = _brownian_size(self)
        return super().disturbance_size if motions is None else motions

    @abc.abstractmethod
    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        r"""The time derivative of the state.

        **Arguments:**

        - `t`: time, a scalar.
        - `x`: state, shape `(state_size,)`.
        - `u`: control, shape `(control_size,)`.
        - `w`: disturbance, shape `(disturbance_size,)` if the system has
            `disturbance_names` (zeros if there is no disturbance), else `None`.

        **Returns:** $\dot x$, shape `(state_size,)`.
        """

    def project(self, x: State) -> State:
        """Project the state back onto its manifold after each control interval. By
        default, the state is returned unchanged. Override `project` to normalise a
        quaternion or to wrap an angle.

        **Arguments:** `x`: state, shape `(state_size,)`.

        **Returns:** the projected state, of the same shape.
        """
        return x

    def diffusion(self, t: Time, x: State, u: Control) -> Array | None:
        r"""The matrix $g$ of $\mathrm{d}x = f \,\mathrm{d}t + g \,\mathrm{d}B$; none by
        default.

        If there is a diffusion, the disturbance `w` holds the increments of the $k$
        Brownian motions over the step. You may name them in `disturbance_names`.

        **Arguments:** `t`: time, a scalar. `x`: state, shape `(state_size,)`. `u`:
            control, shape `(control_size,)`.

        **Returns:** $g$, shape `(state_size, k)`; or its diagonal, shape
        `(state_size,)`, with one motion for each state; or `None` for a deterministic
        system.
        """
        del t, x, u
        return None


def _brownian_size(system: AbstractSystem) -> int | None:
    """The number of Brownian motions of `system`; `None` without a diffusion."""
    if not system.declares_noise():
        return None
    name, n, names = type(system).__name__, system.state_size, system.disturbance_names
    g = output_of(system.diffusion, (), (n,), (system.control_size,))
    if g is None:
        return None
    shape = g.shape if isinstance(g, jax.ShapeDtypeStruct) else None
    if shape is None or len(shape) not in (1, 2) or shape[0] != n:
        got = f"a {type(g).__name__}" if shape is None else f"shape {shape}"
        raise ValueError(
            f"{name}: diffusion must return an array of shape ({n}, k), for k Brownian "
            f"motions, or of shape ({n},), for a diagonal, got {got}."
        )
    if names and len(names) != shape[-1]:
        raise ValueError(
            f"{name}: disturbance_names must name the {shape[-1]} Brownian motions of "
            f"the diffusion, got {names}. Name each motion, or leave the names out."
        )
    return shape[-1]
