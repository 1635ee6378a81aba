"""Gymnasium's own `Pendulum-v1`, unwrapped, in a Python loop.

Without the wrappers that `gymnasium.make` adds (order and time limit checks), which is
the fastest way to use it. The controller reads the environment's angle and speed, since
it needs no cosine and sine.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.envs.classic_control import PendulumEnv

from benchmarks._problem import Case, GAIN, GRAVITY
from benchmarks._timing import Contender, Missing, python


NAME = "Gymnasium"


def program(case: Case) -> Callable[[], Any]:
    """The Python loop to time, for one chain from the case's start."""
    environment = PendulumEnv(g=GRAVITY)
    environment.reset(seed=0)
    start = np.array(case.starts(), dtype=np.float64)
    k0, k1 = GAIN

    def trajectory() -> Any:
        environment.state = start
        states, controls, rewards = [start], [], []
        for _ in range(case.steps):
            angle, speed = environment.state
            action = np.array([-(k0 * angle + k1 * speed)], dtype=np.float32)
            _, reward, _, _, _ = environment.step(action)
            states.append(environment.state)
            controls.append(environment.last_u)
            rewards.append(reward)
        return states, controls, rewards

    def cost() -> Any:
        environment.state = start
        total = 0.0
        for _ in range(case.steps):
            angle, speed = environment.state
            action = np.array([-(k0 * angle + k1 * speed)], dtype=np.float32)
            _, reward, _, _, _ = environment.step(action)
            total -= reward
        return total

    def free() -> Any:
        environment.state = start
        action = np.zeros(1, dtype=np.float32)
        for _ in range(case.steps):
            environment.step(action)
        return environment.state

    return {"trajectory": trajectory, "cost": cost, "free": free}[case.workload]


def contender(case: Case, *, name: str = NAME) -> Contender | Missing:
    """One chain of the case, ready to race, or the reason why not."""
    if case.workload == "gradient" or case.method != "gym":
        return Missing(name, "Gymnasium has its own step only, without gradients")
    if case.lanes is not None:
        return Missing(name, "Gymnasium steps one pendulum at a time")
    return python(name, case.total_steps, program(case))


def simulate(case: Case) -> dict[str, np.ndarray]:
    """What a run of one chain returns, in float64: the reference of the checks."""
    outputs = program(case)()
    if case.workload == "trajectory":
        states, controls, rewards = outputs
        outputs = *np.asarray(states).T, controls, -np.asarray(rewards)
    return case.named(outputs)
