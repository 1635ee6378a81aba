"""Runs inside gymnax's virtual environment: compiles and times on request.

Reads one JSON request a line from standard input and answers each with one JSON line:

- `{"prepare": {case}, "stepping": "step"}` -> `{"id": 0, "compile_seconds": 1.2}`
- `{"measure": 0}` -> `{"seconds": 0.01}`
- `{"episodes": {case}, "name": "CartPole-v1", "action": 1, "stepping": "step"}` -> as
  `prepare` does, for whole episodes of any of gymnax's tasks
- `{"simulate": {case}, "stepping": "step"}` -> `{"angle": [...], ...}`
- `{"versions": true}` -> `{"gymnax": "1.0.1", "jax": ...}`
"""

import json
import sys
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import gymnax  # pyright: ignore[reportMissingImports]
import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments.classic_control.pendulum import (  # pyright: ignore[reportMissingImports]
    EnvState,
)

from benchmarks._peers import raw
from benchmarks._problem import Case, Episodes, GAIN
from benchmarks._timing import compiled, Contender


def program(case: Case, stepping: str) -> Callable[..., Any]:
    """The function of `(keys, gain, angle, speed)` to compile.

    The controller reads angle and speed from gymnax's state. Observations, flags and
    infos aren't kept, so the compiler may drop whatever only they need.
    """
    env, params = gymnax.make("Pendulum-v1")
    if case.workload == "gradient":
        env = env.with_transition_gradients()

    def advance(key: Any, state: EnvState, torque: Any) -> tuple[EnvState, jax.Array]:
        if stepping == "step":
            # Automatic reset: draws a new start at every step, and takes it at the
            # time limit.
            _, state, reward, *_ = env.step(key, state, torque, params)
        else:
            # The pendulum never uses its key.
            _, state, reward, *_ = env.step_env(key, state, torque, params)
        return state, reward

    def scan(body: Callable[..., Any], carry: Any, key: jax.Array) -> Any:
        # Keys split before the scan cost less than keys split in it.
        keys = jax.random.split(key, case.steps) if stepping == "step" else None
        return jax.lax.scan(body, carry, keys, case.steps)

    def start(angle: jax.Array, speed: jax.Array) -> EnvState:
        state = EnvState(
            theta=angle, theta_dot=speed, last_u=jnp.zeros_like(angle), time=0
        )
        return jax.tree.map(jnp.asarray, state)

    def controlled(gain: jax.Array, key: Any, state: EnvState) -> Any:
        torque = -(gain[0] * state.theta + gain[1] * state.theta_dot)
        return advance(key, state, torque)

    def trajectory(key: jax.Array, gain: jax.Array, *state: jax.Array) -> Any:
        def body(state: EnvState, key: Any) -> Any:
            new_state, reward = controlled(gain, key, state)
            # gymnax keeps the clipped torque in the state after the step.
            kept = state.theta, state.theta_dot, new_state.last_u, reward
            return new_state, kept

        final, kept = scan(body, start(*state), key)
        return *kept, final.theta, final.theta_dot

    def total_cost(key: jax.Array, gain: jax.Array, *state: jax.Array) -> Any:
        def body(carry: tuple[EnvState, jax.Array], key: Any) -> Any:
            state, total = carry
            state, reward = controlled(gain, key, state)
            return (state, total - reward), None

        return scan(body, (start(*state), jnp.zeros_like(state[0])), key)[0][1]

    def free(key: jax.Array, gain: jax.Array, *state: jax.Array) -> Any:
        def body(state: EnvState, key: Any) -> Any:
            return advance(key, state, jnp.zeros(()))[0], None

        final, _ = scan(body, start(*state), key)
        return final.theta, final.theta_dot

    def batched(function: Callable[..., Any], out_axes: Any = 0) -> Callable[..., Any]:
        if case.lanes is None:
            return function
        return jax.vmap(function, in_axes=(0, None, 0, 0), out_axes=out_axes)

    def mean_cost(key: jax.Array, gain: jax.Array, *state: jax.Array) -> Any:
        return jnp.mean(batched(total_cost)(key, gain, *state))

    return {
        "trajectory": batched(trajectory, out_axes=(1, 1, 1, 1, 0, 0)),
        "cost": batched(total_cost),
        "gradient": jax.value_and_grad(mean_cost, argnums=1),
        "free": batched(free),
    }[case.workload]


def arguments(case: Case) -> tuple[Any, ...]:
    """Keys, gain and starts of a case."""
    key = jax.random.key(0)
    keys = key if case.lanes is None else jax.random.split(key, case.lanes)
    return keys, np.asarray(GAIN, np.float32), *case.starts()


def prepare(case: Case, stepping: str) -> Contender:
    """Compile a case."""
    if stepping == "raw":
        return raw.contender(case)
    function = program(case, stepping)
    return compiled("gymnax", case.total_steps, function, *arguments(case))


def episodes(case: Episodes, name: str, action: Any, stepping: str) -> Contender:
    """Compile whole episodes of one of gymnax's tasks, an action held.

    Each returns the sum of its rewards and its last state. Starts are drawn beforehand.
    """
    env, params = gymnax.make(name)

    def episode(key: jax.Array, action: jax.Array, state: Any) -> Any:
        def body(carry: Any, key: Any) -> Any:
            state, total = carry
            if stepping == "step":
                _, state, reward, *_ = env.step(key, state, action, params)
            else:
                # The acrobot alone uses its key, for a noise of strength 0.
                _, state, reward, *_ = env.step_env(unused, state, action, params)
            return (state, total - reward), None

        unused = key
        keys = jax.random.split(key, case.steps) if stepping == "step" else None
        (state, total), _ = jax.lax.scan(body, (state, jnp.zeros(())), keys, case.steps)
        return total, state

    def run(keys: jax.Array, action: jax.Array, states: Any) -> Any:
        one = lambda inputs: episode(inputs[0], action, inputs[1])
        given = keys, states
        return jax.vmap(one)(given) if case.batched else jax.lax.map(one, given)

    keys = jax.random.split(jax.random.key(0), case.count)
    _, states = jax.vmap(env.reset_env, in_axes=(0, None))(keys, params)
    states = jax.tree.map(jnp.asarray, states)
    return compiled("gymnax", case.total_steps, run, keys, jnp.asarray(action), states)


def simulate(case: Case, stepping: str) -> dict[str, Any]:
    """What a run returns, as lists."""
    outputs = case.named(jax.jit(program(case, stepping))(*arguments(case)))
    if case.workload == "trajectory":
        outputs["cost"] = -outputs["cost"]
    return {name: value.tolist() for name, value in outputs.items()}


def main() -> None:
    """Answer requests until standard input ends."""
    ready: list[Contender] = []
    for line in sys.stdin:
        request = json.loads(line)
        answer: dict[str, Any]
        if "prepare" in request:
            ready.append(prepare(Case(**request["prepare"]), request["stepping"]))
            seconds = ready[-1].compile_seconds
            answer = {"id": len(ready) - 1, "compile_seconds": seconds}
        elif "episodes" in request:
            case = Episodes(**request["episodes"])
            ready.append(
                episodes(case, request["name"], request["action"], request["stepping"])
            )
            seconds = ready[-1].compile_seconds
            answer = {"id": len(ready) - 1, "compile_seconds": seconds}
        elif "measure" in request:
            answer = {"seconds": ready[request["measure"]].measure()}
        elif "simulate" in request:
            answer = simulate(Case(**request["simulate"]), request["stepping"])
        else:
            names = ("gymnax", "jax", "jaxlib", "numpy")
            answer = {name: version(name) for name in names}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
