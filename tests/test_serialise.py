import json
import os
import subprocess
import sys

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import user_error

import delucax as dlx


KEY = jax.random.key(0)
PENDULUM = dlx.systems.Pendulum(length=1.2)


class Mine(eqx.Module):
    gain: jax.Array
    how: object
    name: str = eqx.field(static=True)


def objects():
    env = dlx.make("pendulum", disturbance=dlx.disturbances.Gaussian(0.1, size=2))
    policy = dlx.controllers.Deep(env, width=4, key=KEY)
    controller = diffrax.PIDController(rtol=1e-4, atol=1e-5)
    adaptive = dlx.Discretized(
        PENDULUM, 0.05, diffrax.Kvaerno5(), stepsize_controller=controller
    )
    run = dlx.rollout(env, policy, key=KEY, horizon=5)
    return {
        "env": env,
        "policy": policy,
        "gaussian": dlx.controllers.Deep(env, head="gaussian", key=KEY),
        "adaptive": adaptive,
        "fixed": dlx.Discretized(PENDULUM, 0.05, diffrax.Tsit5(), substeps=3),
        "linear": dlx.linearize(dlx.Discretized(PENDULUM, 0.05)),
        "wraps": dlx.costs.Quadratic(
            jnp.eye(2), jnp.eye(1), difference=PENDULUM.difference
        ),
        "trajectory": run,
        "batch": jax.vmap(dlx.systems.Pendulum)(jnp.ones(3)),
        "optimiser": optax.adam(1e-3).init({"w": jnp.ones(3)}),
        "key": {"typed": KEY, "old": jax.random.PRNGKey(3)},
        "plain": (1, 2.5, None, True, "é", [np.arange(3), np.float32(2)], {"a": 1}),
        "functions": Mine(jnp.ones(2), jax.nn.relu, "x"),
        "ufunc": Mine(jnp.ones(2, jnp.bfloat16), jnp.tanh, "y"),
        "results": dlx.RESULTS.diverged,
    }


OBJECTS = objects()


@pytest.mark.parametrize("name", OBJECTS)
def test_round_trip(name, tmp_path):
    obj = OBJECTS[name]
    path = tmp_path / "it.dlx"
    dlx.save(path, obj)
    trust = (__name__.partition(".")[0],)
    found = dlx.load(path, trust=trust)
    assert jax.tree.structure(found) == jax.tree.structure(obj)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(obj), strict=True):
        if isinstance(b, jax.Array):
            assert a.aval == b.aval
            if jnp.issubdtype(b.dtype, jax.dtypes.prng_key):
                a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)
    assert list(tmp_path.iterdir()) == [path]


def test_does_not_compile_again(tmp_path):
    env = OBJECTS["env"]
    dlx.save(tmp_path / "env", env)
    again = dlx.load(tmp_path / "env")
    count = []

    @eqx.filter_jit
    def f(env):
        count.append(1)
        return env.dynamics.dt * 2

    f(env)
    f(again)
    assert len(count) == 1


def test_what_has_no_name_is_an_error_when_it_is_saved(tmp_path):
    cost = dlx.costs.Function(lambda t, x, u: x[0])
    env = dlx.Environment(dlx.Discretized(PENDULUM, 0.05), cost)
    with user_error(match=r"obj\.cost\.stage\.function is <function .*no name"):
        dlx.save(tmp_path / "bad", env)
    assert not list(tmp_path.iterdir())
    with user_error(match="being traced"):
        jax.jit(lambda x: dlx.save(tmp_path / "bad", x))(1.0)


def test_damaged_and_foreign_files(tmp_path):
    path = tmp_path / "it.dlx"
    dlx.save(path, OBJECTS["policy"])
    whole = path.read_bytes()
    for damaged in (whole[:-5], whole[:200], whole[:300] + b"?" + whole[301:]):
        path.write_bytes(damaged)
        with user_error(match="it.dlx is damaged"):
            dlx.load(path)
    for foreign in (b"", b"PK\x03\x04zip", json.dumps({"a": 1}).encode()):
        path.write_bytes(foreign)
        with user_error(match="is not a file that delucax.save wrote"):
            dlx.load(path)
    path.write_bytes(whole.replace(b"delucax-file 1 ", b"delucax-file 9 ", 1))
    with user_error(match="format 9, newer than"):
        dlx.load(path)
    with user_error(OSError, match="missing.dlx cannot be read"):
        dlx.load(tmp_path / "missing.dlx")
    with user_error(OSError, match="cannot be read"):
        dlx.load(tmp_path)
    with user_error(OSError, match="cannot be written"):
        dlx.save(tmp_path / "no" / "folder.dlx", 1)
    with user_error(OSError, match="cannot be written"):
        dlx.save(tmp_path, 1)


def test_untrusted_names_are_refused(tmp_path):
    path = tmp_path / "it.dlx"
    dlx.save(path, {"run": os.path.join})
    with user_error(match="posixpath:join, of a package that is not trusted"):
        dlx.load(path)


def test_a_changed_class_is_an_error(tmp_path, monkeypatch):
    path = tmp_path / "it.dlx"
    dlx.save(path, PENDULUM)

    class Pendulum(eqx.Module):
        mass: jax.Array

    monkeypatch.setattr(sys.modules[type(PENDULUM).__module__], "Pendulum", Pendulum)
    with user_error(match="has changed since the file was written"):
        dlx.load(path)


def test_a_user_defined_system_of_a_script(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import delucax as dlx, jax, sys\n"
        "class Mine(dlx.AbstractSystem):\n"
        "    state_names = ('x',)\n"
        "    control_names = ('u',)\n"
        "    a: jax.Array = dlx.parameter(2.0)\n"
        "    def vector_field(self, t, x, u, w):\n"
        "        return -self.a * x + u\n"
        "dlx.save('it.dlx', dlx.Discretized(Mine(3.0), 0.1))\n"
        "print(float(dlx.load('it.dlx').system.a))\n"
    )
    out = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True
    )
    assert out.stdout == "3.0\n", out.stderr
    with user_error(match="needs Mine of __main__: define it first"):
        dlx.load(tmp_path / "it.dlx")
