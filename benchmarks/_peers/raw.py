"""Hand-written JAX: the step in a `lax.scan`, and nothing else.

This is the floor that a JAX library can hope to reach. The state is carried as two
separate arrays, the physical constants are folded in by the compiler, and a batch is
`jax.vmap` with time as the first axis of the outputs, which saves a transpose. The scan
keeps the state before each step: with the one after it, XLA computes the step twice,
once to carry it and once to keep it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks._problem import (
    Case,
    DT,
    GAIN,
    GRAVITY,
    LENGTH,
    MASS,
    MAX_SPEED,
    MAX_TORQUE,
)
from benchmarks._timing import compiled, Contender


NAME = "raw lax.scan"

State = tuple[jax.Array, jax.Array]


class Numerics(NamedTuple):
    """The functions that XLA compiles badly on CPU, and so are worth choosing."""

    sin: Callable[[jax.Array], jax.Array] = jnp.sin
    clip: Callable[[jax.Array, float, float], jax.Array] = jnp.clip


PLAIN = Numerics()


def acceleration(angle: jax.Array, torque: Any, numerics: Numerics) -> jax.Array:
    """Angular acceleration of the pendulum."""
    weight = 3 * GRAVITY / (2 * LENGTH) * numerics.sin(angle)
    return weight + 3.0 / (MASS * LENGTH**2) * torque


def wrap(angle: jax.Array) -> jax.Array:
    """The angle brought to `[-pi, pi]`."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def stage_cost(state: State, torque: jax.Array) -> jax.Array:
    """Gymnasium's cost: minus its reward."""
    angle, speed = state
    return wrap(angle) ** 2 + 0.1 * speed**2 + 0.001 * torque**2


def gym_step(state: State, torque: Any, numerics: Numerics) -> State:
    """Gymnasium's semi-implicit Euler step with its bound on the speed."""
    angle, speed = state
    speed = speed + acceleration(angle, torque, numerics) * DT
    speed = numerics.clip(speed, -MAX_SPEED, MAX_SPEED)
    return angle + speed * DT, speed


def rk4_step(state: State, torque: Any, numerics: Numerics) -> State:
    """One classical Runge-Kutta step of the ODE, the torque held."""
    angle, speed = state
    half = 0.5 * DT
    v1, a1 = speed, acceleration(angle, torque, numerics)
    v2, a2 = speed + half * a1, acceleration(angle + half * v1, torque, numerics)
    v3, a3 = speed + half * a2, acceleration(angle + half * v2, torque, numerics)
    v4, a4 = speed + DT * a3, acceleration(angle + DT * v3, torque, numerics)
    sixth = DT / 6
    return (
        angle + sixth * (v1 + 2 * (v2 + v3) + v4),
        speed + sixth * (a1 + 2 * (a2 + a3) + a4),
    )


def tsit5_step(state: State, torque: Any, numerics: Numerics) -> State:
    """One Tsit5 step by Diffrax's own `Tsit5().step`, the torque held.

    The state is an array here, as Diffrax's users write it. The torque jumps at every
    step, so the last stage can't be used again (`made_jump=True`) and the solver's own
    state is never read.
    """
    import diffrax

    def field(t: Any, y: jax.Array, args: Any) -> jax.Array:
        return jnp.stack([y[1], acceleration(y[0], args, numerics)])

    y = jnp.stack(state)
    solver_state = (True, jnp.zeros_like(y))
    y, *_ = diffrax.Tsit5().step(
        diffrax.ODETerm(field), 0.0, DT, y, torque, solver_state, made_jump=True
    )
    return y[0], y[1]


STEPS = {"gym": gym_step, "rk4": rk4_step, "tsit5": tsit5_step}


def program(
    case: Case, *, numerics: Numerics = PLAIN, checkpoint: bool = False
) -> Callable[[jax.Array, jax.Array, jax.Array], Any]:
    """The function of `(gain, angle, speed)` to compile for a case.

    It returns, by workload:

    - `"trajectory"`: angles and speeds before each step, controls, costs, each
      `[steps]` or `[steps, lanes]`; then the final angle and speed;
    - `"cost"`: the total cost, `[]` or `[lanes]`;
    - `"gradient"`: the (mean) total cost and its gradient with respect to the gain;
    - `"free"`: the final angle and speed.

    `checkpoint=True` recomputes each step in the backward pass.
    """
    advance = STEPS[case.method]

    def controlled(gain: jax.Array, state: State) -> tuple[State, jax.Array, jax.Array]:
        torque = -(gain[0] * state[0] + gain[1] * state[1])
        torque = numerics.clip(torque, -MAX_TORQUE, MAX_TORQUE)
        return advance(state, torque, numerics), torque, stage_cost(state, torque)

    if checkpoint:
        controlled = jax.checkpoint(controlled)

    def trajectory(gain: jax.Array, angle: jax.Array, speed: jax.Array) -> Any:
        def body(state: State, _: None) -> Any:
            new_state, torque, cost = controlled(gain, state)
            return new_state, (*state, torque, cost)

        final, kept = lax.scan(body, (angle, speed), None, case.steps)
        return *kept, *final

    def total_cost(gain: jax.Array, angle: jax.Array, speed: jax.Array) -> jax.Array:
        def body(carry: tuple[State, jax.Array], nothing: None) -> Any:
            state, total = carry
            state, _, cost = controlled(gain, state)
            return (state, total + cost), None

        start = (angle, speed), jnp.zeros_like(angle)
        return lax.scan(body, start, None, case.steps)[0][1]

    def free(gain: jax.Array, angle: jax.Array, speed: jax.Array) -> State:
        def body(state: State, _: None) -> Any:
            return advance(state, 0.0, numerics), None

        return lax.scan(body, (angle, speed), None, case.steps)[0]

    def batched(function: Callable[..., Any], out_axes: Any = 0) -> Callable[..., Any]:
        if case.lanes is None:
            return function
        return jax.vmap(function, in_axes=(None, 0, 0), out_axes=out_axes)

    def mean_cost(gain: jax.Array, angle: jax.Array, speed: jax.Array) -> jax.Array:
        return jnp.mean(batched(total_cost)(gain, angle, speed))

    match case.workload:
        case "trajectory":
            return batched(trajectory, out_axes=(1, 1, 1, 1, 0, 0))
        case "cost":
            return batched(total_cost)
        case "gradient":
            return jax.value_and_grad(mean_cost)
        case "free":
            return batched(free)


def contender(
    case: Case,
    *,
    numerics: Numerics = PLAIN,
    checkpoint: bool = False,
    name: str = NAME,
) -> Contender:
    """Compile the case and return it ready to race; the options are `program`'s."""
    function = program(case, numerics=numerics, checkpoint=checkpoint)
    gain = np.asarray(GAIN, np.float32)
    return compiled(name, case.total_steps, function, gain, *case.starts())


def simulate(case: Case, **options: Any) -> dict[str, np.ndarray]:
    """What a run of the case returns, by `Case.named`."""
    function = jax.jit(program(case, **options))
    return case.named(function(np.asarray(GAIN, np.float32), *case.starts()))
