import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from helpers import assert_close, once, user_error
from jaxtyping import Array

import delucax as dlx
from delucax._module import get_path
from delucax.training import fit


pytestmark = once


class Plant(eqx.Module):
    mass: Array = dlx.parameter(1.0, constraint=dlx.positive)
    friction: Array = dlx.parameter(0.1)
    steps: int = 3
    rate: float = 0.5


class Model(eqx.Module):
    plant: Plant
    gain: Array = dlx.weight()
    fraction: Array = dlx.weight(0.5, constraint=dlx.bounded(0.0, 1.0))


def model():
    return Model(plant=Plant(), gain=jnp.ones(2))


def down(model, key):
    """Everything is pulled to minus infinity."""
    floats = jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array))
    return sum(jnp.sum(leaf) for leaf in floats)


def moved(trainable=None, start=None, steps=2, rate=0.01):
    start = model() if start is None else start
    optimiser = optax.sgd(rate)
    end = fit(
        down,
        start,
        optimiser,
        steps,
        key=jr.key(0),
        trainable=trainable,
        progress=False,
    ).model
    return {
        name
        for name in ("plant.mass", "plant.friction", "gain", "fraction")
        if not np.array_equal(get_path(start, name), get_path(end, name))
    }


def test_ways_to_say_what_moves():
    every = {"plant.mass", "plant.friction", "gain", "fraction"}
    assert moved() == {"gain", "fraction"}
    assert moved("plant.friction") == {"plant.friction"}
    assert moved("plant") == {"plant.mass", "plant.friction"}
    assert moved(["gain", "plant.mass"]) == {"gain", "plant.mass"}
    assert moved({"plant.friction": dlx.positive}) == {"plant.friction"}
    assert moved(eqx.is_inexact_array) == every
    spec = jax.tree.map(lambda _: False, model())
    spec = eqx.tree_at(lambda m: m.gain, spec, True)
    assert moved(spec) == {"gain"}
    prefix = eqx.tree_at(lambda m: m.plant, spec, False)
    assert moved(prefix) == {"gain"}


def test_a_path_does_not_catch_its_namesakes():
    start = {"gain": jnp.ones(1), "gain2": jnp.ones(1)}
    end = fit(
        down, start, optax.sgd(0.1), 1, key=jr.key(0), trainable="gain", progress=False
    ).model
    assert end["gain"] != 1 and end["gain2"] == 1


def test_a_path_goes_through_sequences_and_dictionaries():
    start = [{"a": (jnp.ones(2), jnp.zeros(2))}, jnp.ones(1)]
    end = fit(
        down, start, optax.sgd(0.1), 1, key=jr.key(0), trainable="0.a.1", progress=False
    ).model
    assert_close(end[0]["a"][1], [-0.1, -0.1], rtol=1e-6)
    assert np.all(end[0]["a"][0] == 1) and end[1] == 1


def test_constraints_hold_however_far_training_goes():
    start = model()
    for trainable in (
        ["plant.mass", "fraction"],
        {"plant.mass": None, "fraction": None},
    ):
        end = fit(
            down,
            start,
            optax.adam(1.0),
            500,
            key=jr.key(0),
            trainable=trainable,
            progress=False,
        ).model
        assert 0 < end.plant.mass < 1e-3
        assert 0 < end.fraction < 1e-3
        # What comes out is legal, so it can go in again.
        dlx.replace(end, {"fraction": end.fraction, "plant.mass": end.plant.mass})
        assert moved(trainable, start=end, steps=1, rate=0.0) <= set(trainable)


def test_the_mapping_overrides_the_field():
    end = fit(
        down,
        model(),
        optax.adam(1.0),
        300,
        key=jr.key(0),
        trainable={"plant.mass": dlx.bounded(0.5, 2.0)},
        progress=False,
    ).model
    assert 0.5 < end.plant.mass < 0.5001


def test_the_step_is_taken_in_the_unconstrained_value():
    end = fit(
        lambda m, key: m.plant.mass,
        Model(plant=Plant(mass=2.0), gain=jnp.ones(2)),
        optax.sgd(0.1),
        1,
        key=jr.key(0),
        trainable="plant.mass",
        progress=False,
    ).model
    # z = log m, and dm/dz = m.
    assert_close(end.plant.mass, np.exp(np.log(2.0) - 0.1 * 2.0), rtol=1e-6)


def test_wrong_choices_are_named():
    cases = (
        (
            "'plant.steps' must be a floating-point array, or hold some, got 3",
            "plant.steps",
        ),
        ("must be a floating-point array.*got 0.5.*delucax.parameter", "plant.rate"),
        ("Plant has no 'mas'.*did you mean 'mass'", ["plant.mas"]),
        ("Model has no 'gan'", {"gan": dlx.positive}),
        ("each path to delucax.positive", {"gain": dlx.positive, "fraction": 3}),
        ("booleans in the structure of the model", [True, False]),
        (
            "picks 'plant.steps', which is not a floating-point array: 3",
            lambda leaf: True,
        ),
        ("True or False for each leaf, got 'yes'", lambda leaf: "yes"),
        ("nothing in Model is trainable: .*picks no leaf", lambda leaf: False),
        ("nothing in Model is trainable", []),
        ("gain must be bounded.*got", {"gain": dlx.bounded(0.0, 1.0)}),
    )
    for match, trainable in cases:
        with user_error(match=match):
            moved(trainable)


def test_wrong_ends_are_named():
    for low, high, match in (
        (1, 1, "low must be below high, got 1.0 and 1.0"),
        (0, np.inf, "low and high must be finite, got 0.0 and inf.*delucax.positive"),
    ):
        with user_error(match=match):
            dlx.bounded(low, high)


def test_nothing_marked_says_what_could_be():
    with user_error(
        match="nothing in Plant is trainable: no field is marked .*'mass', 'friction'"
    ):
        moved(start=Plant())
    with user_error(match="that could be are none"):
        moved(start={"n": 3})


def test_an_initial_value_must_be_finite():
    start = {"w": jnp.array([1.0, jnp.nan])}
    with user_error(match="fit: w must be finite"):
        moved(eqx.is_inexact_array, start=start)
