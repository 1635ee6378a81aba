import math

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pytest
from helpers import (
    assert_close,
    CountCalls,
    dtype,
    needs_x64,
    once,
    tolerance,
    user_error,
)
from jaxtyping import Array

import delucax as dlx
from delucax.training import fit
from delucax.training._optimiser import Optimiser


class Line(eqx.Module):
    slope: Array = dlx.weight(0.0)
    offset: Array = dlx.weight(0.0)
    scale: Array = dlx.parameter(2.0)

    def __call__(self, x):
        return self.scale * (self.slope * x + self.offset)


def distance(model, key):
    return (model.slope - 1.0) ** 2 + (model.offset + 2.0) ** 2 + 0 * model.scale


def train(loss=distance, model=None, optimiser=None, steps=20, **kwargs):
    options = dict(key=jr.key(0), progress=False) | kwargs
    model = Line() if model is None else model
    optimiser = optax.sgd(0.1) if optimiser is None else optimiser
    return fit(loss, model, optimiser, steps, **options)


def same_bits(a, b):
    return all(
        np.array_equal(np.asarray(x), np.asarray(y))
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


def test_gradient_descent_is_what_is_written_down():
    fitted = train(steps=20)
    # The distance to the minimum shrinks by 1 - 2 * 0.1 a step.
    left = 0.8**20
    assert_close(fitted.model.slope, 1 - left, rtol=1e-5)
    assert_close(fitted.model.offset, -2 + 2 * left, rtol=1e-5)
    history = fitted.history
    k = np.arange(20)
    np.testing.assert_array_equal(history.step, k)
    assert_close(history.loss, 5 * 0.8 ** (2 * k), rtol=1e-4)
    assert_close(history.gradient_norm, 2 * np.sqrt(5) * 0.8**k, rtol=1e-4)
    assert np.all(np.diff(history.seconds) >= 0) and history.seconds[0] > 0
    assert fitted.result == dlx.RESULTS.successful


@once
def test_only_weights_move_by_default():
    assert train(lambda m, key: (m(1.0) - 5.0) ** 2).model.scale == 2.0


@once
def test_the_result_does_not_depend_on_the_block():
    def loss(model, key):
        return (model(jr.normal(key)) - 1.0) ** 2, {"drawn": jr.normal(key)}

    optimiser = optax.adam(0.05)
    runs = [train(loss, optimiser=optimiser, steps=23, block=b) for b in (1, 7, 1000)]
    for run in runs[1:]:
        assert same_bits(runs[0].model, run.model)
        for name in ("step", "loss", "gradient_norm", "drawn"):
            np.testing.assert_array_equal(runs[0].history[name], run.history[name])
    drawn = [jr.normal(jr.fold_in(jr.key(0), k)) for k in range(23)]
    np.testing.assert_array_equal(runs[0].history["drawn"], np.stack(drawn))


@once
def test_a_second_fit_does_not_compile_again():
    calls = CountCalls()

    def loss(model, batch, key):
        calls()
        return jnp.mean((model(batch) - 1.0) ** 2)

    make = lambda: optax.chain(optax.clip(1.0), optax.adam(0.1, b1=0.8))
    first = train(
        loss, optimiser=make(), steps=10, data=np.ones(8), batch_size=4, block=4
    )
    traced = calls.count
    assert traced == 1  # and the last block is shorter than the others
    other = Line(slope=0.7, offset=3.0, scale=1.5)
    for model, steps, key in ((first.model, 10, jr.key(1)), (other, 3, jr.key(2))):
        train(
            loss,
            model,
            make(),
            steps,
            key=key,
            data=np.zeros(8),
            batch_size=4,
            block=4,
        )
    assert calls.count == traced


@once
def test_optimisers_are_equal_if_made_in_the_same_way():
    schedule = {10: 0.5}
    makers = [
        lambda: optax.adam(1e-3),
        lambda: optax.adam(2e-3),
        lambda: optax.adamw(1e-3),
        lambda: optax.scale(1),
        lambda: optax.scale(1.0),
        lambda: optax.adam(optax.piecewise_constant_schedule(0.1, schedule)),
        lambda: optax.masked(optax.sgd(0.1), {"a": True}),
        lambda: optax.masked(optax.sgd(0.1), {"b": True}),
        lambda: optax.lbfgs(),
        # An array is compared by identity, because its numbers may change.
        lambda: optax.sgd(np.ones(3)),
    ]
    made = [(Optimiser(make()), Optimiser(make())) for make in makers]
    assert all(hash(one) == hash(again) for one, again in made[:-1])
    for i, (one, _) in enumerate(made):
        assert [one == again for _, again in made] == [
            i == j < len(makers) - 1 for j in range(len(makers))
        ]
    schedule[20] = 0.1
    assert Optimiser(makers[5]()) != made[5][0]


RATE = 0.1


def test_an_optimiser_that_reads_a_global(monkeypatch):
    def make():
        halved = lambda step: RATE / 2  # in a schedule within another function
        return Optimiser(optax.sgd(lambda step: halved(step)))

    first = make()
    assert first == make()
    monkeypatch.setitem(globals(), "RATE", 0.2)
    assert first != make()
    # A new array may get the identity of one that is gone.
    monkeypatch.setitem(globals(), "RATE", np.ones(3))
    second = make()
    monkeypatch.setitem(globals(), "RATE", np.zeros(3))
    assert second != make()


def test_an_optimiser_may_close_over_what_has_no_value_yet():
    adam = optax.adam(0.1)

    def update(updates, state, params=None):
        return later(updates), state

    optimiser = Optimiser(optax.GradientTransformation(adam.init, update))
    assert optimiser == optimiser and optimiser != Optimiser(adam)
    later = lambda updates: updates


def test_weakly_typed_leaves_stay_so():
    model = Line()
    assert model.slope.weak_type
    # In float64 runs the parameters are float64, and must not widen a float32 scan.
    x = jnp.ones(3, jnp.float32)

    def loss(model, key):
        final, _ = jax.lax.scan(
            lambda y, v: (model.slope * v + 0.5 * y, None), jnp.float32(0), x
        )
        return (final - 1.0) ** 2

    fitted = train(loss, model, optax.adam(0.1), trainable=["slope", "offset"])
    assert fitted.model.slope.weak_type and fitted.model.offset.weak_type
    assert fitted.model.slope.dtype == model.slope.dtype
    assert fitted.model.slope != 0
    batched = eqx.filter_vmap(lambda s: Line(slope=s * model.slope))(jnp.ones(3))
    fitted = train(lambda m, key: jnp.sum(m.slope**2), batched, trainable="slope")
    assert fitted.model.slope.weak_type == batched.slope.weak_type
    assert fitted.model.slope.shape == (3,)


@needs_x64
def test_precision_of_each_leaf_is_kept():
    model = {"single": jnp.ones(2, jnp.float32), "double": jnp.ones(2, jnp.float64)}

    def loss(m, key):
        return jnp.sum(m["single"] ** 2) + jnp.sum(m["double"] ** 2)

    fitted = train(loss, model, optax.adam(0.1), trainable=eqx.is_inexact_array)
    assert fitted.model["single"].dtype == jnp.float32
    assert fitted.model["double"].dtype == jnp.float64


def test_half_precision_gradients_do_not_overflow_the_norm():
    model = {"w": jnp.full(4, 300.0, jnp.float16)}
    fitted = train(
        lambda m, key: jnp.sum(m["w"].astype(jnp.float32) ** 2) / 2,
        model,
        optax.sgd(1e-3),
        steps=2,
        trainable=eqx.is_inexact_array,
    )
    assert_close(fitted.history.gradient_norm[0], 600.0, rtol=1e-3)


@once
def test_rows_are_drawn_without_replacement():
    data = jnp.arange(10)

    def loss(model, batch, key):
        counts = {f"row{i}": jnp.sum(batch == i) for i in range(10)}
        return model.slope**2, counts

    history = train(loss, steps=9, data=data, batch_size=3).history
    counts = np.stack([history[f"row{i}"] for i in range(10)], axis=1)
    assert np.all(counts.sum(1) == 3)
    passes = counts.reshape(3, 3, 10).sum(1)
    assert passes.max() == 1  # nine of the ten rows, once each
    assert len({tuple(row) for row in counts}) > 3  # another order in each pass


@once
def test_all_rows_without_a_batch_size():
    x = np.linspace(-1, 1, 9)

    def loss(model, batch, key):
        x, y = batch
        return jnp.mean((model(x) - y) ** 2)

    fitted = train(loss, optimiser=optax.sgd(0.1), steps=200, data=(x, 3 * x - 1))
    assert_close(fitted.model(1.0), 2.0, atol=1e-3)


@once
def test_a_network_with_numpy_leaves_trains():
    model = (eqx.nn.MLP(1, 1, 8, 1, key=jr.key(0)), {"bias": np.zeros(1)})

    def loss(model, key):
        net, extra = model
        x = jr.normal(key, (16, 1))
        return jnp.mean((jax.vmap(net)(x) + extra["bias"] - x - 4.0) ** 2)

    optimiser = optax.adam(0.05)
    where = eqx.is_inexact_array
    fitted = train(loss, model, optimiser, steps=200, trainable=where)
    assert fitted.history.loss[-1] < 0.05 * fitted.history.loss[0]
    assert isinstance(fitted.model[1]["bias"], jax.Array)


@once
@pytest.mark.parametrize(
    "loss,optimiser,what,step",
    [
        (lambda m, key: jnp.log(1 - m.slope), optax.sgd(0.5), "loss", 2),
        (lambda m, key: jnp.sqrt(jnp.abs(m.slope)), optax.sgd(0.5), "gradient", 0),
        (lambda m, key: m.slope, optax.sgd(lambda k: 1 / (3.0 - k)), "update", 3),
    ],
)
def test_what_is_not_finite_stops_the_run(loss, optimiser, what, step):
    model = Line(slope=-1.0 if what == "loss" else 0.0)
    if what == "loss":
        # d/ds log(1 - s) = -1 / (1 - s): up by 1/4, 2/7, and so on to s >= 1.
        model = Line(slope=0.0)
    for block in (2, 100):
        with pytest.raises(RuntimeError, match=f"the {what} is not finite at step "):
            train(loss, model, optimiser, steps=20, block=block)
    fitted = train(loss, model, optimiser, steps=20, throw=False)
    assert fitted.result == dlx.RESULTS.diverged
    assert fitted.history.step[-1] == step and len(fitted.history) == step + 1
    assert np.isfinite(fitted.model.slope)
    assert np.all(np.isfinite(fitted.history.loss[:-1]))
    if step:
        before = train(loss, model, optimiser, steps=step)
        assert same_bits(before.model, fitted.model)


@once
def test_callbacks_are_told_of_each_block():
    heard = []
    train(
        lambda m, key: (m.slope**2 + 1, {"twice": 2 * m.slope}),
        Line(slope=1.0),
        steps=10,
        block=4,
        callbacks=[lambda step, metrics: heard.append((step, metrics))],
    )
    assert [step for step, _ in heard] == [4, 8, 10]
    step, metrics = heard[-1]
    assert set(metrics) == {"step", "loss", "gradient_norm", "seconds", "twice"}
    assert all(type(value) is float for value in metrics.values())
    assert metrics["step"] == 9
    assert_close(metrics["twice"], 2 * 0.8**9, rtol=1e-5)
    assert_close(metrics["loss"], 1 + 0.8**18, rtol=1e-5)


@once
def test_callbacks_are_told_the_mean_of_the_seeds_that_go_on():
    heard = []
    models = eqx.filter_vmap(lambda s: Line(slope=s))(jnp.array([1.0, -1.0]))
    fitted = train(
        lambda m, key: jnp.sqrt(m.slope),
        models,
        steps=4,
        key=jr.split(jr.key(0), 2),
        throw=False,
        callbacks=[lambda step, metrics: heard.append(metrics["loss"])],
    )
    assert np.isnan(fitted.history.loss[-1, 1])
    assert_close(heard[-1], fitted.history.loss[-1, 0])


@once
@pytest.mark.parametrize("boolean", [bool, np.bool_, jnp.array])
def test_a_callback_stops_the_training(tmp_path, boolean):
    heard = []

    def stop(step, metrics):
        heard.append(step)
        return boolean(step >= 4)

    options = dict(block=2, checkpoint=tmp_path / "run")
    short = train(callbacks=[stop, lambda *_: None], **options)
    assert heard == [2, 4] and len(short.history) == 4
    # The checkpoint has the steps so far.
    resumed = train(callbacks=[lambda step, _: heard.append(step)], **options)
    assert heard[2:] == list(range(6, 21, 2)) and len(resumed.history) == 20


@once
def test_the_bar_ticks_once_a_block(capsys):
    train(steps=10, block=5, progress=True)
    assert "10/10" in capsys.readouterr().err
    train(steps=10, block=5, progress=False)
    assert capsys.readouterr().err == ""


@once
def test_the_history_is_a_table():
    history = train(lambda m, key: (m.slope**2, {"x": m.slope}), steps=5).history
    assert len(history) == 5
    table = history.to_pandas()
    assert list(table) == ["step", "loss", "gradient_norm", "seconds", "x"]
    assert len(table) == 5
    with pytest.raises(KeyError, match="no column 'y'; there are step, loss"):
        history["y"]


def test_optimisers_that_ask_for_the_loss_get_it():
    def rosenbrock(m, key):
        return (1 - m.slope) ** 2 + 100 * (m.offset - m.slope**2) ** 2

    fitted = train(rosenbrock, Line(slope=-1.2, offset=1.0), optax.lbfgs(), steps=60)
    assert_close(fitted.model.slope, 1.0, atol=tolerance(1e-3, 1e-6))


@once
def test_the_optimiser_sees_values_by_path():
    optimiser = optax.multi_transform(
        {"fast": optax.sgd(0.4), "still": optax.set_to_zero()},
        {"slope": "fast", "offset": "still"},
    )
    fitted = train(optimiser=optimiser)
    assert_close(fitted.model.slope, 1.0, atol=1e-4)
    assert fitted.model.offset == 0.0


@once
def test_any_function_may_be_the_gradient():
    def signs(loss, values, key):
        value, gradient = dlx.training.analytic(loss, values, key)
        return value, jax.tree.map(jnp.sign, gradient)

    fitted = train(gradient=signs, optimiser=optax.sgd(0.25), steps=4)
    assert fitted.model.slope == 1.0 and fitted.model.offset == -1.0
    with user_error(match="gradient must return .* like the values"):
        train(gradient=lambda loss, values, key: (jnp.zeros(()), 1.0))


@once
def test_evolution_strategies_train():
    estimator = dlx.training.EvolutionStrategies(0.1, samples=16)
    fitted = train(
        lambda m, key: jnp.floor(10 * distance(m, key)) / 10,  # no gradient at all
        optimiser=optax.sgd(0.05),
        steps=100,
        gradient=estimator,
    )
    assert_close(fitted.model.slope, 1.0, atol=0.1)
    assert_close(fitted.model.offset, -2.0, atol=0.1)


@once
def test_wrong_arguments_are_named():
    data = jnp.ones((4, 2))
    of_data = lambda model, batch, key: model.slope
    for match, change in (
        ("optimiser must be an Optax optimiser such as optax.adam", {"optimiser": 0.1}),
        ("steps must be a whole number of at least 1, got 0", {"steps": 0}),
        (r"key must be one random key such as jax.random.key\(0\), got 0", {"key": 0}),
        ("loss must be a function", {"loss": 1.0}),
        ("block must be a whole number of at least 1", {"block": 0}),
        ("block must be at most 1000, got 2000", {"block": 2000}),
        ("gradient must be an estimator", {"gradient": 3}),
        ("batch_size needs data", {"batch_size": 2}),
        (
            "at most the 4 rows of data, got 5",
            dict(loss=of_data, data=data, batch_size=5),
        ),
        ("common leading axis", dict(loss=of_data, data=(data, jnp.ones(3)))),
        ("common leading axis", dict(loss=of_data, data=(data, 3.0))),
        (r"a function of \(model, key\), got <lambda>", {"loss": of_data}),
        ("callbacks must be a sequence", {"callbacks": print}),
        ("checkpoint_every needs checkpoint", {"checkpoint_every": 3}),
    ):
        with user_error(match=match):
            train(**change)


@once
def test_a_loss_must_return_a_scalar():
    for match, loss in (
        (r"loss must return a scalar, got shape \(2,\)", lambda m, k: jnp.ones(2)),
        ("floating-point scalar, got dtype int", lambda m, k: jnp.asarray(1)),
        ("loss must return a scalar, got NoneType", lambda m, k: None),
        ("dictionary of metrics, got an array", lambda m, k: (m.slope, m.slope)),
        (r"metric 'x' must be a scalar, got shape", lambda m, k: (m.slope, {"x": [1]})),
        (
            "metrics must not be called .* got 'loss'",
            lambda m, k: (m.slope, {"loss": 1}),
        ),
    ):
        with user_error(match=match):
            train(loss)


@once
def test_under_a_transformation_there_is_an_error():
    def trained(slope):
        return train(model=Line(slope=slope)).model.slope

    with user_error(match="fit cannot be called under"):
        jax.grad(trained)(1.0)


@once
def test_a_whole_policy_trains_under_fit():
    env = dlx.environments.lds(
        jnp.array([[1.0, 0.1], [0.0, 1.0]]),
        jnp.array([[0.0], [0.1]]),
        horizon=30,
        initial_state=jnp.array([1.0, 0.0]),
    )
    loss = dlx.training.expected_cost(env, batch=1)
    start = dlx.controllers.Linear(jnp.zeros((1, 2), dtype()))
    fitted = train(loss, start, optax.adam(0.1), steps=100)
    best = fitted.history.loss[-1]
    assert math.isfinite(best) and best < 0.6 * fitted.history.loss[0]
