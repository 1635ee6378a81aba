"""What was published with Deluca, from files of random arrays of its shapes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, needs_x64, once, user_error

import delucax as dlx
from delucax import lung
from delucax._module import stack


SIM, DEEP = "sim/params/", "deep_controller/params/deep_"


def published_arrays(seed=0):
    """As in the file of the authors, the newest control, pressure and error last."""
    rng = np.random.default_rng(seed)
    normal = lambda *shape: rng.normal(size=shape).astype(np.float32)
    scales = {"u_scaler": (11.0, 16.0), "p_scaler": (21.0, 10.0)}
    arrays = {}
    for name, (mean, std) in scales.items():
        arrays |= {f"sim/{name}/mean": np.array(mean), f"sim/{name}/std": np.array(std)}
    for k in range(5):
        names = [f"{SIM}{k}/shallow_fc{i}_model{k + 1}/" for i in (1, 2)]
        arrays[f"{names[0]}kernel"] = 0.5 * normal(10, 100)
        arrays[f"{names[1]}kernel"] = 0.1 * normal(100, 1)
        arrays[f"{names[1]}bias"] = normal(1)
    for k, size in enumerate((10, 100, 100)):
        arrays[f"{SIM}5/SNN_fc{k}/kernel"] = 0.1 * normal(size, 100)
    arrays |= {f"{SIM}5/SNN_fc3/kernel": 0.1 * normal(100, 1)}
    arrays |= {f"{SIM}5/SNN_fc3/bias": normal(1)}
    arrays["deep_controller/featurizer"] = np.tril(np.abs(normal(10, 10)))
    arrays |= {f"{DEEP}conv/kernel": normal(5, 10, 100)}
    arrays |= {f"{DEEP}conv/bias": normal(100)}
    arrays |= {
        f"{DEEP}fc/kernel": 0.02 * normal(100, 1),
        f"{DEEP}fc/bias": 9 + normal(1),
    }
    return arrays


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("published") / "arrays.npz"
    np.savez(path, **published_arrays())
    return path


def pressures_by_hand(arrays, controls):
    """The pressures of an inspiration, as a program of lists that grow."""
    u, p = [0.0] * 5, [0.0] * 4 + [-1.51449]
    for k, control in enumerate(controls):
        u.append((control - arrays["sim/u_scaler/mean"]) / arrays["sim/u_scaler/std"])
        if k < 5:
            z = np.array(u[-5:] + p[-5:])
            name = f"{SIM}{k}/shallow_fc{{}}_model{k + 1}/"
            hidden = np.tanh(z @ arrays[name.format(1) + "kernel"])
            last = name.format(2)
        else:
            hidden = np.array([0.0, 0.0, *u[-5:], *p[-3:]])
            for layer in range(3):
                z = hidden @ arrays[f"{SIM}5/SNN_fc{layer}/kernel"]
                negative = 1.6732632423543772 * (np.exp(z) - 1)
                hidden = 1.0507009873554805 * np.where(z > 0, z, negative)
            last = f"{SIM}5/SNN_fc3/"
        p.append(float((hidden @ arrays[f"{last}kernel"] + arrays[f"{last}bias"])[0]))
    return arrays["sim/p_scaler/mean"] + arrays["sim/p_scaler/std"] * np.array(p[4:])


def test_the_lung_by_hand(file):
    model, _ = lung.read_published(file)
    controls = np.random.default_rng(1).uniform(0, 60, 12)
    u = jnp.stack([jnp.asarray(controls), jnp.zeros(12)], 1)

    @eqx.filter_jit
    def run(model, u):
        states = dlx.open_loop(model, model.resting(), u)
        opened = model(0.0, states[7], jnp.array([30.0, 1.0]))
        return jax.vmap(model.pressure)(states), opened

    found, opened = run(model, u)
    assert_close(found, pressures_by_hand(published_arrays(), controls), rtol=1e-4)
    # The expiratory valve makes it forget.
    assert_close(opened, model.resting())
    assert len(model.state_names) == model.state_size


def test_the_controller_by_hand(file):
    arrays = published_arrays()
    waveform = lung.BreathWaveform(pip=20.0)
    controller = lung.read_published(file, waveform).controller
    call, state = eqx.filter_jit(controller), controller.init()
    controls, errors = [], np.zeros(10)
    for k in range(12):
        y = 20.0 + 0.3 * np.sin(k) * (k < 11)
        errors = np.append(errors[1:], 20.0 - y)
        z = errors @ arrays["deep_controller/featurizer"]
        z = z @ arrays[f"{DEEP}conv/kernel"][2] + arrays[f"{DEEP}conv/bias"]
        z = np.maximum(0, z) @ arrays[f"{DEEP}fc/kernel"] + arrays[f"{DEEP}fc/bias"]
        u, state = call(0.03 * k, jnp.array([y]), state)
        assert_close(u, np.clip(z, 0, 40), rtol=1e-3, atol=1e-3)
        controls.append(float(u[0]))
    assert len({0.0, 40.0}.union(controls)) > 3  # some are inside of the bounds


@needs_x64
def test_gradients_through_both(file):
    """In a batch, and as finite differences say."""
    model, controller = lung.read_published(file)

    def error(controller):
        def body(carry, k):
            x, state = carry
            y = model.observe(0.0, x)
            u, state = controller(0.03 * k, y, state)
            return (model(0.0, x, jnp.append(u, 0.0)), state), jnp.abs(y[0] - 20.0)

        start = model.resting(), controller.init()
        return jnp.sum(jax.lax.scan(body, start, jnp.arange(8.0))[1])

    at = lambda bias: eqx.tree_at(lambda c: c.bias, controller, jnp.asarray(bias))
    three = stack([at(bias) for bias in (9.9999, 10.0, 10.0001)])
    both = eqx.filter_vmap(eqx.filter_value_and_grad(error))
    (low, _, high), slopes = eqx.filter_jit(both)(three)
    assert low != high
    assert_close(slopes.bias[1], (high - low) / 2e-4, rtol=1e-4)
    env = lung.learned_lung(model)
    assert env.dt == 0.03 and env.state_size == model.state_size + 1


@once
@pytest.mark.parametrize(
    "change, said",
    [
        ({"sim/p_scaler/std": None}, r"lacks the array 'sim/p_scaler/std' of shape \("),
        (
            {f"{SIM}5/SNN_fc1/kernel": np.ones((100, 90))},
            r"'sim/params/5/SNN_fc1/kernel' of shape \(100, 100\).*got shape \(100, 90",
        ),
        ({f"{DEEP}fc/bias": np.array([np.nan])}, "deep_fc/bias' of .* must be finite"),
        ({f"{DEEP}fc/bias": np.ones(1, int)}, "of floats, got shape .1,. and int"),
        ({"sim/u_scaler/std": np.array(0.0)}, "u_std"),
    ],
)
def test_a_file_of_another_format(tmp_path, change, said):
    arrays = published_arrays() | change
    path = tmp_path / "arrays.npz"
    np.savez(path, **{name: a for name, a in arrays.items() if a is not None})
    with user_error(ValueError, match=said):
        lung.read_published(path)


@once
def test_arguments(tmp_path, file):
    path = tmp_path / "text.npz"
    path.write_text("no arrays")
    with user_error(ValueError, match=r"text.npz' must be an .npz file"):
        lung.read_published(path)
    with user_error(FileNotFoundError, match="path must be a file"):
        lung.read_published(tmp_path / "none.npz")
    with user_error(ValueError, match="path must be the path of a file, got 3"):
        lung.read_published(3)
    with user_error(ValueError, match="waveform must be a BreathWaveform"):
        lung.read_published(file, waveform=3.0)
    model, controller = lung.read_published(file)
    with user_error(ValueError, match=r"hidden must have the shape \(5, width, 10\)"):
        eqx.tree_at(lambda m: m.hidden, model, jnp.zeros((4, 3, 10))).__check_init__()
    with user_error(ValueError, match=r"featurizer must have the shape \(10, 10\)"):
        dlx.replace(controller, {"featurizer": jnp.zeros((9, 10))})
