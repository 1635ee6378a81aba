import os
import signal
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
import pytest
from helpers import once, user_error
from jaxtyping import Array

import delucax as dlx
from delucax.training import fit


pytestmark = once


class Line(dlx.AbstractController):
    slope: Array = dlx.weight(0.0)
    size: Array = dlx.weight(1.0, constraint=dlx.positive)
    shift: Array = dlx.parameter(0.5)

    def __call__(self, t, y, state):
        return self.size * (self.slope * y + self.shift), state


DATA = np.linspace(-1.0, 1.0, 7)
STEPS = 20


def loss(model, batch, key):
    u, _ = model(0.0, batch, None)
    noise = 0.1 * jr.normal(key, batch.shape)
    return jnp.mean((u - 3 * batch + noise) ** 2), {"noise": noise[0]}


# An optimiser whose state holds a random key, which Equinox cannot write as it is.
NOISY = optax.chain(optax.add_noise(0.01, 0.55, jr.key(3)), optax.adam(0.1))


def train(path=None, **kwargs):
    options = dict(
        optimiser=NOISY,
        steps=STEPS,
        key=jr.key(0),
        data=DATA,
        batch_size=3,
        block=2,
        progress=False,
        checkpoint=path,
        checkpoint_every=None if path is None else 4,
    )
    options |= kwargs
    return fit(options.pop("loss", loss), options.pop("model", Line()), **options)


def assert_same_run(a, b):
    for x, y in zip(jax.tree.leaves(a.model), jax.tree.leaves(b.model), strict=True):
        np.testing.assert_array_equal(x, y)
        assert x.weak_type == y.weak_type
    for name in ("step", "loss", "gradient_norm", "noise"):
        np.testing.assert_array_equal(a.history[name], b.history[name])


def saved_steps(path):
    return len(dlx.load(path)["history"]["step"])


class Cut(Exception):
    pass


def cut_at(step):
    def callback(done, metrics):
        if done >= step:
            raise Cut

    return callback


@pytest.mark.parametrize("block", [2, 3])
def test_a_run_that_was_cut_off_goes_on_to_the_same_bits(tmp_path, block):
    path = tmp_path / "new" / "fit.ckpt"
    with pytest.raises(Cut):
        train(path, callbacks=[cut_at(14)])
    heard = []
    resumed = train(path, block=block, callbacks=[lambda k, _: heard.append(k)])
    assert heard[0] == 12 + block  # written after 4, 8 and 12
    assert_same_run(train(), resumed)
    assert np.all(np.diff(resumed.history.seconds) >= 0)
    # A run that is at its end trains no more.
    heard.clear()
    again = train(path, callbacks=[lambda k, _: heard.append(k)])
    assert not heard
    assert_same_run(resumed, again)


def test_a_killed_process_leaves_a_whole_checkpoint(tmp_path):
    path = tmp_path / "fit.ckpt"
    script = f"""
        import os, signal, sys
        sys.path[:0] = {[os.path.dirname(__file__), *sys.path]!r}
        from test_checkpoint import train

        def kill(step, metrics):
            if step >= 10:
                os.kill(os.getpid(), signal.SIGKILL)

        train({str(path)!r}, callbacks=[kill])
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], capture_output=True
    )
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    assert saved_steps(path) == 8
    assert_same_run(train(), train(path))


def test_a_failed_write_leaves_the_one_before(tmp_path, monkeypatch):
    path = tmp_path / "fit.ckpt"
    with pytest.raises(Cut):
        train(path, callbacks=[cut_at(4)])
    before = path.read_bytes()

    def full(*args):
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        with pytest.raises(OSError, match="No space"):
            train(path)
    assert path.read_bytes() == before
    assert_same_run(train(), train(path))


@pytest.fixture(scope="module")
def half_way(tmp_path_factory):
    path = tmp_path_factory.mktemp("fit") / "fit.ckpt"
    with pytest.raises(Cut):
        train(path, callbacks=[cut_at(4)])
    return path


def test_another_run_is_refused(half_way):
    before = half_way.read_bytes()
    two = Line(slope=jnp.zeros(2))
    other = {"slope": None, "size": dlx.bounded(0, 9)}
    for match, change in (
        ("steps is 20 there and 30 here", {"steps": 30}),
        ("key is .* there", {"key": jr.key(1)}),
        ("batch_size is 3 there and 2 here", {"batch_size": 2}),
        ("data_size is 7 there and 6 here", {"data": DATA[:6]}),
        (r"trainable slope is float..\[\] .* and float..\[2\]", {"model": two}),
        ("trainable shift is None there", {"trainable": ["slope", "size", "shift"]}),
        ("trainable size is .* positive there and .* bounded", {"trainable": other}),
        ("optimiser .* is .* there and None here", {"optimiser": optax.sgd(0.1)}),
        (r"model.shift at the start is", {"model": Line(shift=0.6)}),
        (r"model.slope at the start is", {"model": Line(slope=0.1)}),
        ("its history has .*noise", {"loss": lambda *args: loss(*args)[0]}),
    ):
        with user_error(match=match):
            train(half_way, **change)
        assert half_way.read_bytes() == before


def test_a_start_that_differs_by_rounding_is_the_same_run(tmp_path, half_way):
    path = tmp_path / "copy.ckpt"
    path.write_bytes(half_way.read_bytes())
    train(path, model=Line(shift=0.5 * (1 + 1e-6)), steps=STEPS)


def test_what_is_no_checkpoint_is_refused(tmp_path, half_way):
    text = tmp_path / "notes.txt"
    text.write_text("hello")
    with user_error(match="must be a file that fit has written"):
        train(text)
    assert text.read_text() == "hello"
    other = tmp_path / "model.dlx"
    dlx.save(other, Line())
    with user_error(match="must be a file that fit has written"):
        train(other)
    short = tmp_path / "short.ckpt"
    short.write_bytes(half_way.read_bytes()[:-200])
    with user_error(match="Reading it failed: .* is damaged"):
        train(short)


def test_a_folder_that_cannot_be_written_to_is_told_before_training(tmp_path):
    (tmp_path / "file").write_text("")

    def never(model, batch, key):
        raise AssertionError("training began")

    with user_error(match="must be in a folder that can be written to"):
        train(tmp_path / "file" / "fit.ckpt", loss=never)
    with user_error(match="must be the path of a file, such as"):
        train(tmp_path, loss=never)


def test_a_run_that_diverges_keeps_its_last_checkpoint(tmp_path):
    path = tmp_path / "fit.ckpt"
    options = dict(
        loss=lambda m, b, k: (jnp.log(1 - m.slope), {"noise": m.slope}),
        optimiser=optax.sgd(0.1),
    )
    fitted = train(path, throw=False, **options)
    assert fitted.result == dlx.RESULTS.diverged
    step = saved_steps(path)
    assert 0 < step < len(fitted.history)
    assert_same_run(fitted, train(path, throw=False, **options))


def test_infinite_bounds_do_not_make_another_run(tmp_path):
    model = {"limits": jnp.array([-jnp.inf, jnp.inf]), "w": jnp.ones(1)}

    def pull(model, batch, key):
        return jnp.sum(model["w"] ** 2), {"noise": 0.0}

    options = dict(loss=pull, model=model, trainable="w", optimiser=optax.sgd(0.1))
    path = tmp_path / "fit.ckpt"
    with pytest.raises(Cut):
        train(path, callbacks=[cut_at(4)], **options)
    assert_same_run(train(**options), train(path, **options))


@pytest.mark.parametrize("what", ["loss", "learning rate", "data"])
def test_another_loss_rate_or_data_is_another_run(tmp_path, what):
    model = dlx.controllers.Linear([[20.0, 5.0]])
    rows = jnp.ones(6)

    def fit(target=1.0, rate=0.1, data=rows):
        return dlx.training.fit(
            lambda m, batch, key: jnp.mean(batch) * jnp.sum((m.K - target) ** 2),
            model,
            optax.adam(rate),
            steps=4,
            key=jax.random.key(0),
            data=data,
            checkpoint=tmp_path / "run.ckpt",
            progress=False,
        )

    first = fit()
    assert jnp.all(fit().model.K == first.model.K)
    other = {"loss": {"target": -9.0}, "learning rate": {"rate": 5.0}}
    other["data"] = {"data": 2 * rows}
    with user_error(match="is of another run: the .* of its first steps"):
        fit(**other[what])
