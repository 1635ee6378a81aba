"""Slips in a safety filter, and the words for them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once, user_error

import delucax as dlx


pytestmark = once

c = dlx.controllers
ZERO = c.Zero(1)
PENDULUM = dlx.systems.Pendulum()
STEPPED = dlx.Discretized(PENDULUM, 0.1)
INSIDE = lambda t, x: 1 - x[0]


def made(controller=ZERO, plant=PENDULUM, barriers=INSIDE, **options):
    return c.SafetyFilter(controller, plant, barriers, **options)


def system(f, **sizes):
    return dlx.system(f, **(dict(states=2, controls=1) | sizes))


PUSHED = system(lambda t, x, u, w: jnp.stack([x[1], u[0] + w[0] ** 2]), disturbances=1)
SQUARED = system(lambda t, x, u, w: jnp.stack([x[1], u[0] ** 2]))
CLIPPED = system(lambda t, x, u, w: jnp.stack([x[1], jnp.clip(u[0], -1, 1)]))
CHAIN = system(lambda t, x, u, w: jnp.stack([x[1], x[2], u[0]]), states=3)
STILL = system(lambda t, x, u, w: jnp.stack([x[1], -x[0]]))
NAMES = {"angle": INSIDE, "speed": lambda t, x: 2 - x[1]}


@pytest.mark.parametrize(
    "call, match",
    [
        (lambda: made(controller=3), "controller must be an AbstractController"),
        (lambda: made(plant=3), "plant must be an AbstractSystem"),
        (lambda: made(barriers=3), r"barriers\['barrier'\] must be a function"),
        (lambda: made(barriers={}), "barriers must not be empty"),
        (lambda: made(barriers={"a": len}), r"\['a'\] must be .* \(t, x\), got len"),
        (
            lambda: made(barriers={"a": lambda t, x: x[0, 0]}),
            r"\['a'\] fails when .* \(t, x\)",
        ),
        (
            lambda: made(barriers={"a": lambda t, x: x[None]}),
            "'a'.* number or a vector",
        ),
        (lambda: made(barriers=lambda t, x: jnp.log(x[0] - 9)), "finite at one of the"),
        (lambda: made(plant=CHAIN), "barriers must see .*'barrier' does not.* second"),
        (
            lambda: made(plant=STILL, barriers=NAMES),
            "barriers must see the control at relative degree 1 or 2, but 'angle'",
        ),
        (
            lambda: made(barriers=NAMES | {"hour": lambda t, x: 1 + t}),
            "barriers must see the control .* 'hour' does not",
        ),
        (
            lambda: made(plant=STEPPED, barriers=lambda t, x: 1.0 + t),
            "'barrier' does not.* even two steps later",
        ),
        (lambda: made(plant=SQUARED), "plant must have .* affine in the control"),
        (lambda: made(plant=CLIPPED), "plant must have .* affine in the control"),
        (lambda: made(plant=PUSHED, disturbance=1.0), "affine in the disturbance"),
        (lambda: made(decay=-1.0), "decay must be at least 0"),
        (lambda: made(decay=np.nan), "decay must be at least 0"),
        (lambda: made(decay=np.inf), "decay must be finite"),
        (lambda: made(decay=(1.0, 2.0, 3.0)), "decay must be a number or a pair"),
        (lambda: made(plant=STEPPED, decay=1.5), "decay must be between 0 and 1"),
        (lambda: made(decay={"other": 1.0}), "decay must have the names of .*'other'"),
        (
            lambda: made(barriers=NAMES, decay={"angle": 1.0}),
            "decay must have a value for 'speed'",
        ),
        (lambda: made(margin=np.nan), "margin must be finite"),
        (lambda: made(margin=[0.0, 1.0]), "margin must be a number"),
        (lambda: made(disturbance=1.0), "disturbance_names"),
        (lambda: made(plant=PUSHED, disturbance=[1.0, 2.0]), "disturbance must"),
        (
            lambda: made(plant=STEPPED, disturbance=-1.0),
            "disturbance must be at least 0",
        ),
        (lambda: made(bounds=(1.0, -1.0)), "bounds must have low <= high"),
        (lambda: made(bounds=(-np.ones(2), np.ones(2))), "bounds must be numbers or"),
        (lambda: made(bounds=(np.nan, 1.0)), "bounds must have low <= high"),
        (lambda: made(price=0.0), "price must be positive"),
        (lambda: made(price=np.nan), "price must be positive"),
        (lambda: made(weight=0.0), "weight must be positive"),
        (lambda: made(weight=[1.0, 2.0]), "weight must be a number or have shape"),
        (lambda: made(states=np.ones(2)), r"states must have shape \(steps, 2\)"),
        (lambda: made(states=[[np.nan, 0.0]]), "states must be finite"),
        (lambda: made(max_iterations=0), "max_iterations must be a whole number"),
        (
            lambda: jax.jit(lambda m: made(plant=dlx.systems.Pendulum(m)).decay)(1.0),
            "degrees must be given",
        ),
        (lambda: made(degrees=3), "degrees must be 1 or 2"),
        (lambda: made(degrees=1), "degrees must be 2 for"),
        (lambda: made(degrees={"angle": 1}), "degrees must have the names of"),
    ],
)
def test_words(call, match):
    with user_error(match=match):
        call()


def test_a_control_of_another_size():
    safe = made(c.Zero(2))
    with user_error(match=r"SafetyFilter: controller must return .* \(1,\).* \(2,\)"):
        safe(0.0, jnp.zeros(2), safe.init())


def test_where_the_control_is_seen_is_an_argument():
    """Of states at which it is not, and of others at which it is."""
    field = lambda t, x, u, w: jnp.stack([x[1], jnp.maximum(x[0] - 9, 0) * u[0]])
    plant = system(field)
    with user_error(match="barriers must see the control"):
        made(plant=plant)
    assert made(plant=plant, states=[[10.0, 0.0]]).degrees == (2,)


def test_a_plant_may_be_traced():
    """With the degrees given, the filter is the same as one that is made outside."""
    x = jnp.array([0.9, 0.5])

    @jax.jit
    def acted(mass):
        safe = made(plant=dlx.systems.Pendulum(mass), degrees=2)
        return safe(0.0, x, safe.init())[0]

    safe = made(plant=dlx.systems.Pendulum(0.7))
    np.testing.assert_allclose(acted(0.7), safe(0.0, x, safe.init())[0], rtol=1e-5)


def test_numbers_may_be_traced():
    made_with = lambda decay: made(decay=decay, margin=decay, price=decay).decay.sum()
    assert jax.jit(made_with)(2.0) == 4.0
