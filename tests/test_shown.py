"""How modules and results print."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import needs_x32, once
from jaxtyping import Array

import delucax as dlx
from delucax._module import shown


pytestmark = once


class Part(eqx.Module):
    gain: Array
    network: Array
    step: float = eqx.field(static=True, default=0.1)
    label: str | None = None

    __repr__ = shown


class Whole(eqx.Module):
    parts: tuple[Part, ...]
    point: dlx.dynamics.OperatingPoint | None = None
    names: tuple[str, ...] = ()

    __repr__ = shown


def part(**options):
    return Part(jnp.array([1.0, 2 / 3]), jnp.zeros((32, 3)), **options)


@needs_x32
def test_small_arrays_show_their_values():
    assert repr(dlx.systems.VanDerPol()) == "VanDerPol(mu=1.0)"
    assert repr(part()) == "Part(gain=[1.0, 0.6667], network=f32[32,3], step=0.1)"
    known = Part(np.array([[3, -12]]), jax.random.key(0), 0.1 + 0.2, "a")
    text = "Part(gain=[[3, -12]], network=key<fry>[], step=0.3, label='a')"
    assert repr(known) == text
    odd = Part(jnp.array([True, False]), jnp.zeros((0, 2)), 12345678.0)
    assert repr(odd) == "Part(gain=[True, False], network=f32[0,2], step=1.235e+07)"
    special = Part(jnp.array([jnp.nan, -jnp.inf]), jnp.array(1 + 2j), 1e-9)
    assert repr(special) == "Part(gain=[nan, -inf], network=1+2j, step=1e-09)"


@needs_x32
def test_what_has_no_value_shows_its_shape():
    texts = []
    jax.jit(lambda m: texts.append(repr(m)) or m)(part())
    assert texts == ["Part(gain=f32[2], network=f32[32,3], step=0.1)"]
    deleted = jnp.ones(2)
    deleted.delete()
    assert "gain=f32[2]" in repr(Part(deleted, deleted))
    assert repr(jax.eval_shape(part)) == texts[0]


def test_long_texts_are_shortened():
    assert "step" not in repr(Whole((part(),)))  # of a part, the default is left out
    many = repr(Whole(tuple(part(label="x" * 30) for _ in range(20)), names=("a",)))
    assert many == "Whole(parts=tuple(...), names=('a',))"
    for name in ("pendulum", "quadrotor", "double_compartment"):
        env = dlx.make(name)
        lines = repr(env).splitlines()
        assert len(lines) <= 14 and max(map(len, lines)) <= 100, name
        assert "horizon=" in repr(env)


def test_functions_show_their_names():
    system = dlx.system(lambda t, x, u, w: u, states=1, controls=1)
    assert "0x" not in repr(system) and "<lambda>" in repr(system)
    assert "<function tanh>" in repr(Whole((jnp.tanh,)))


def test_a_trajectory_shows_its_outcome():
    env = dlx.make("pendulum", horizon=20)
    run = lambda key: dlx.rollout(env, dlx.controllers.Zero(1), key=key)
    one = repr(run(jax.random.key(0)))
    assert len(one.splitlines()) <= 12
    for words in ("states=f", "[21,2]", "length=20", "result=<RESULTS.successful>"):
        assert words in one
    many = repr(jax.vmap(run)(jax.random.split(jax.random.key(0), 8)))
    assert "[8,21,2]" in many and "<RESULTS: 8 successful>" in many


def test_results_show_name_and_message():
    results = dlx.RESULTS
    assert repr(results.successful) == "<RESULTS.successful>"
    message = results[results.diverged]
    assert repr(results.diverged) == f"<RESULTS.diverged: {message}>"
    stopped = results.promote(diffrax.RESULTS.max_steps_reached)
    assert repr(stopped).startswith("<RESULTS.max_steps_reached: The maximum")
    pick = lambda k: results.where(k > 0, results.successful, results.diverged)
    batch = jax.vmap(pick)(jnp.arange(3))
    assert repr(batch) == "<RESULTS: 2 successful, 1 diverged>"
    each = [dlx.RESULTS[batch[i]] for i in range(3)]
    assert each == [dlx.RESULTS[result] for result in batch]
    assert sorted(map(bool, each)) == [False, False, True]
    assert repr(batch[:0]) == "<RESULTS: >"
    with pytest.raises((IndexError, TypeError)):
        dlx.RESULTS.successful[0]
    texts = []
    jax.jit(lambda k: texts.append(repr(pick(k))))(1)
    assert texts == ["<RESULTS: traced>"]


@pytest.mark.parametrize("name", ["successful", "diverged"])
def test_results_are_of_one_kind(name):
    item = getattr(dlx.RESULTS, name)
    made = dlx.RESULTS.where(jnp.array(True), item, dlx.RESULTS.not_converged)
    assert jax.tree.structure(made) == jax.tree.structure(item)
    assert dlx.RESULTS.where(jnp.array(True), item, item) is item
    assert isinstance(made, dlx.RESULTS) and made == item


@needs_x32
def test_functions_say_what_they_are():
    dynamics = dlx.Discretized(dlx.systems.Pendulum(), dt=0.05)
    cost = dlx.costs.Quadratic([1.0, 1.0], [1.0])
    env = dlx.Environment(dynamics, cost)
    assert "encode" not in repr(env)
    heard = dlx.replace(env, {"encode": jnp.cos})
    assert "encode=<function cos>" in repr(heard)
    assert "difference=Discretized.difference" in repr(dlx.controllers.local_lqr(env))
