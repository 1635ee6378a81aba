"""Physical, neural and grey-box models of a lung, which are fitted to breaths."""

from typing import Any, cast, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array

from .._check import check_count, check_instance, check_key, check_step
from .._module import mlp, parameter, positive, shown, weight
from .._typing import (
    Control,
    Disturbance,
    PRNGKey,
    Real,
    RealScalar,
    Scalar,
    State,
    Time,
)
from ..dynamics import Delayed, Discretized
from ._lungs import AbstractLung, SingleCompartment
from ._ventilation import Valves


class LungModel(eqx.Module):
    """A lung as a differential equation and a sensor, which can be fitted to breaths.

    **Arguments:**

    - `system`: a [`delucax.lung.AbstractLung`][].
    - `dt`: the time between samples [s], 0.03 by default.
    - `sensor_delay`: the number of steps until a pressure is observed, 2 by default.
    - `peep`: the pressure at rest before an inspiration [cmH2O], 5 by default.
    - `solver`: a Diffrax solver, [`delucax.dynamics.RK4`][] by default.

    **Raises:** `ValueError` if `system` is not an `AbstractLung` or `dt` is not
    positive.

    !!! example

        ```python
        import jax.numpy as jnp
        from delucax.lung import LungModel, SingleCompartment

        model = LungModel(SingleCompartment(resistance=5.0))
        model.predict(jnp.linspace(50.0, 0.0, 5)).round(1)
        ```

        ```text
        Array([ 5. ,  5. ,  5. ,  9.5, 11.5], dtype=float32)
        ```
    """

    dynamics: Delayed
    peep: Array = parameter()

    __repr__ = shown

    def __init__(
        self,
        system: AbstractLung,
        dt: Any = 0.03,
        sensor_delay: int = 2,
        peep: Any = 5.0,
        solver: diffrax.AbstractSolver | None = None,
    ):
        where = "LungModel"
        check_instance(system, AbstractLung, "system", where)
        check_step(dt, where)
        delay = check_count(sensor_delay, "sensor_delay", where, least=0)
        self.dynamics = Delayed(Discretized(system, dt, solver), sensor=delay)
        self.peep = peep

    @property
    def system(self) -> Any:
        """The lung."""
        return cast(Any, self.dynamics).dynamics.system

    def resting(self) -> State:
        """The state of the dynamics before an inspiration."""
        return self.dynamics.filled(self.system.resting(self.peep))

    def predict(self, u_in: Array) -> Array:
        """Predict the pressures of an inspiration from its controls, in open loop.

        **Arguments:** `u_in`: the controls [%], shape `(T,)`.

        **Returns:** the pressures [cmH2O], shape `(T,)`. The first is the pressure
        before any control acted.
        """

        # The gradient keeps only the states and computes the steps again.
        @jax.checkpoint
        def body(x, u):
            both = jnp.stack([u, jnp.zeros_like(u)])
            after, _ = self.dynamics.advance(0.0, x, both, None)
            return after, self.dynamics.observe(0.0, x)[0]

        x0 = self.resting().astype(u_in.dtype)
        return jax.lax.scan(body, x0, u_in)[1]


class NeuralLung(AbstractLung):
    r"""A lung as a neural ODE. Its state consists of a pressure and some hidden states.

    $$\dot z = \mathrm{rate} \cdot
    \mathrm{network}(z, q(u_\mathrm{in}) / q_\mathrm{max}, u_\mathrm{out}), \qquad
    p = p_\mathrm{mean} + p_\mathrm{std} z_0$$

    Here $q$ is the flow of the inspiratory valve, which is known and not learned. The
    vector field is smooth.

    **Arguments:**

    - `hidden`: the number of hidden states, 2 by default.
    - `width`, `depth`: the hidden units and hidden layers of the network, 24 and 1 by
        default.
    - `valves`: a [`delucax.lung.Valves`][], which gives $q$; `Valves()` by default.
    - `key`: a random key, for the first weights.

    **Attributes:** `network`, trainable; `p_mean` and `p_std`, the scale of the
        pressures, 20 and 10 cmH2O; `rate`, the scale of the time derivatives, 10 / s.

    **Raises:** `ValueError` if a size is below 1, or `key` is missing.

    Source: Chen, Rubanova, Bettencourt and Duvenaud, 2018.

    !!! example

        ```python
        import jax
        import jax.numpy as jnp
        from delucax.lung import LungModel, NeuralLung

        model = LungModel(NeuralLung(key=jax.random.key(0)))
        model.predict(jnp.linspace(50.0, 0.0, 10))
        ```
    """

    network: eqx.nn.MLP = weight()
    p_mean: Real = parameter()
    p_std: Real = parameter(constraint=positive)
    rate: Real = parameter(constraint=positive)
    valves: Valves
    hidden: int = eqx.field(static=True)

    def __init__(
        self,
        hidden: int = 2,
        width: int = 24,
        depth: int = 1,
        *,
        valves: Valves | None = None,
        key: PRNGKey,
    ):
        where = "NeuralLung"
        self.hidden = check_count(hidden, "hidden", where)
        check_count(width, "width", where)
        check_count(depth, "depth", where)
        check_key(key, where)
        sizes = self.hidden + 3, self.hidden + 1, width, depth
        self.network = mlp(*sizes, key=key)
        self.p_mean, self.p_std, self.rate = 20.0, 10.0, 10.0
        self.valves = Valves() if valves is None else valves

    @property
    def state_names(self) -> tuple[str, ...]:
        return ("pressure", *(f"hidden {i}" for i in range(self.hidden)))

    def pressure(self, x: State) -> Scalar:
        return self.p_mean + self.p_std * x[0]

    def resting(self, pressure: RealScalar) -> State:
        first = (pressure - self.p_mean) / self.p_std
        return jnp.hstack([first, jnp.zeros(self.hidden)])

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        # Scaled to be about 1.
        flow = self.valves.flow(u[0]) / self.valves.max_flow
        z = jnp.concatenate([x, jnp.stack([flow, u[1]]).astype(x.dtype)])
        return (self.rate * self.network(z)).astype(x.dtype)


class GreyBoxLung(AbstractLung):
    r"""A single-compartment lung, with neural networks for the effects that the
    single-compartment model leaves out.

    $$p = p_\mathrm{single}(x) + p_\mathrm{std} \, \mathrm{network}(q,
    V / (C p_\mathrm{std}), h), \qquad
    \dot h = \mathrm{rate} \cdot \mathrm{memory}(q, V / (C p_\mathrm{std}), h)$$

    The state is (inflow $q$ [L/s], opening, volume $V$ [L], memory $h$). Before
    training the output of the first network is small, so that the model is close to the
    physical model. The vector field is not smooth at an opening of 0.

    **Arguments:**

    - `single`: a [`delucax.lung.SingleCompartment`][]; `SingleCompartment()` by
        default.
    - `width`: the number of hidden units of both networks, 16 by default.
    - `key`: a random key, for the first weights.

    **Attributes:** `network` and `memory`, trainable; `p_std`, the scale of the
        pressures, 10 cmH2O; `rate`, the scale of $\dot h$, which is 5 / s.

    **Raises:** `ValueError` if a size is below 1, or `key` is missing.

    !!! example

        ```python
        import jax
        import jax.numpy as jnp
        from delucax.lung import GreyBoxLung, LungModel

        model = LungModel(GreyBoxLung(key=jax.random.key(0)))
        model.predict(jnp.linspace(50.0, 0.0, 10))
        ```
    """

    single: SingleCompartment
    network: eqx.nn.MLP = weight()
    memory: eqx.nn.MLP = weight()
    p_std: Real = parameter(constraint=positive)
    rate: Real = parameter(constraint=positive)

    state_names: ClassVar = ("inflow", "opening", "volume", "memory")
    state_units: ClassVar = ("L/s", "", "L", "")

    def __init__(
        self, single: SingleCompartment | None = None, width: int = 16, *, key: PRNGKey
    ):
        where = "GreyBoxLung"
        check_key(key, where)
        width = check_count(width, "width", where)
        self.single = SingleCompartment() if single is None else single
        network, self.memory = (
            mlp(3, "scalar", width, 1, key=k) for k in jr.split(key)
        )
        last = lambda mlp: mlp.layers[-1].weight
        self.network = eqx.tree_at(last, network, 0.1 * last(network))
        self.p_std, self.rate = 10.0, 5.0

    @property
    def valves(self) -> Valves:
        """The valves of the single compartment."""
        return self.single.valves

    def _inputs(self, x: Array) -> Array:
        inside = x[2] / (1e-3 * self.single.compliance)
        return jnp.stack([x[0], inside / self.p_std, x[3]])

    def pressure(self, x: State) -> Scalar:
        rest = self.network(self._inputs(x))
        return self.single.pressure(x[:3]) + self.p_std * rest

    def resting(self, pressure: RealScalar) -> State:
        return jnp.append(self.single.resting(pressure), 0.0)

    def vector_field(self, t: Time, x: State, u: Control, w: Disturbance) -> State:
        physical = self.single.vector_field(t, x[:3], u, w)
        memory = self.rate * self.memory(self._inputs(x))
        return jnp.append(physical, memory)
