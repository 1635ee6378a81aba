import functools
import hashlib
import json
import os
import sys
import types

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import optax
import pytest
from helpers import assert_close, needs_x32, needs_x64, once, user_error
from jaxtyping import Array

import delucax as dlx


KEY = jr.key(0)
PENDULUM = dlx.systems.Pendulum(length=1.2)
ENV = dlx.make("pendulum")


class Damper(dlx.AbstractController):
    """A user's own class, of a module that is not trusted by itself."""

    gain: Array = dlx.weight(1.0)

    def __call__(self, t, y, state):
        return -self.gain * y[1:], state


class Static(eqx.Module):
    """With a static field that holds all that one may."""

    table: dict = eqx.field(static=True)


def double(x):
    return 2 * x


halve = lambda x: x / 2


@eqx.filter_jit
def compiled(x):
    return x + 1


def rollout(key, controller=None):
    controller = dlx.controllers.Zero(1) if controller is None else controller
    return dlx.rollout(ENV, controller, key=key, horizon=5)


def batch_of_plants():
    draw = lambda key: dlx.randomise(ENV, key, {"dynamics.system.length": (0.8, 1.2)})
    return jax.vmap(draw)(jr.split(KEY, 4))


def sequential():
    a, b = jr.split(KEY)
    layers = [eqx.nn.Linear(2, 3, key=a), eqx.nn.Lambda(jnp.sin)]
    return eqx.nn.Sequential([*layers, eqx.nn.Linear(3, 1, key=b)])


THINGS = {
    "environment": lambda: ENV,
    "batch of environments": batch_of_plants,
    "trajectory": lambda: rollout(KEY),
    "batch of trajectories": lambda: jax.vmap(rollout)(jr.split(KEY, 3)),
    "simulated trajectory": lambda: dlx.simulate(
        PENDULUM, jnp.zeros((3, 1)), 0.0, 0.15, jnp.ones(2)
    ),
    "fixed-step implicit": lambda: dlx.Discretized(PENDULUM, 0.05, diffrax.Kvaerno3()),
    "adaptive": lambda: dlx.Discretized(
        PENDULUM,
        0.05,
        diffrax.Tsit5(),
        stepsize_controller=diffrax.PIDController(rtol=1e-3, atol=1e-6),
        adjoint=diffrax.BacksolveAdjoint(solver=diffrax.Dopri5()),
    ),
    "linear dynamics": lambda: dlx.linearize(dlx.Discretized(PENDULUM, 0.05)),
    # Any function of four arguments, from a module that is trusted.
    "system of a function": lambda: dlx.system(dlx.open_loop, states=1, controls=1),
    "cost with a bound method": lambda: dlx.costs.Quadratic(
        jnp.eye(2), jnp.eye(1), difference=PENDULUM.difference
    ),
    "sum of disturbances": lambda: (
        dlx.disturbances.Gaussian(0.1, size=2) + dlx.disturbances.Constant(jnp.ones(2))
    ),
    "policy": lambda: dlx.controllers.MLP(2, 1, key=KEY),
    "network": lambda: eqx.nn.MLP(2, 1, 8, 2, key=KEY),
    "network of other activations": lambda: eqx.nn.MLP(
        2, 1, 8, 2, activation=jnp.tanh, final_activation=jax.nn.sigmoid, key=KEY
    ),
    "sequential": sequential,
    "recurrent cell": lambda: eqx.nn.GRUCell(2, 3, key=KEY),
    "optimiser state": lambda: optax.adam(1e-3).init({"a": jnp.ones(2)}),
    "result": lambda: dlx.RESULTS.not_converged,
    "results of a batch": lambda: jax.vmap(
        lambda k: dlx.RESULTS.where(k > 1, dlx.RESULTS.successful, dlx.RESULTS.diverged)
    )(jnp.arange(3)),
    "result of Diffrax": lambda: diffrax.RESULTS.max_steps_reached,
    "constraints": lambda: (dlx.positive, dlx.bounded(0.0, 2.0)),
    "keys": lambda: (KEY, jr.split(KEY, 3), jr.key(1, impl="rbg"), jr.PRNGKey(2)),
    "bound method": lambda: PENDULUM.acceleration,
    "partial": lambda: jax.tree_util.Partial(jnp.sin, jnp.ones(2)),
    "partial of Equinox": lambda: eqx.Partial(dlx.math.sin, jnp.ones(2)),
    "functions": lambda: [
        jnp.add,
        jax.nn.relu,
        jax.nn.swish,
        jnp.linalg.norm,
        np.tanh,
        jnp.float32,
        dlx.math.wrap,
    ],
    "sentinels": lambda: (frozenset([lx.symmetric_tag]), diffrax.Kvaerno5()),
    "numbers": lambda: (1, -0.0, 1e-320, 2**70, True, None, "é\n", 1 - 2j, [1.5, ()]),
    "not numbers": lambda: (float("inf"), -float("inf")),
    "weak types": lambda: (
        jnp.asarray(1.5),
        jnp.asarray(3),
        jnp.broadcast_to(jnp.asarray(2.5), (2, 3)),
    ),
    "arrays": lambda: {
        "half": jnp.ones(3, jnp.bfloat16),
        "empty": jnp.zeros((0, 3)),
        "bool": jnp.array([True, False]),
        "small": np.arange(3, dtype=np.int8),
        "scalar": np.float32(1.5),
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "complex": jnp.array([1 + 2j]),
        "nan": np.array([np.nan, np.inf]),
    },
    "dtype": lambda: np.dtype("float32"),
}


def assert_same_leaf(a, b):
    assert type(a) is type(b)
    if isinstance(a, jax.Array) and jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
        assert a.dtype == b.dtype
        a, b = jr.key_data(a), jr.key_data(b)
    if isinstance(a, jax.Array):
        assert a.weak_type == b.weak_type
    if isinstance(a, jax.Array | np.ndarray | np.generic):
        assert a.dtype == b.dtype and a.shape == b.shape
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
    elif isinstance(a, float):
        assert repr(a) == repr(b)
    else:
        assert a == b


@once
@pytest.mark.parametrize("name", THINGS)
def test_round_trip_is_exact(name, tmp_path):
    thing = THINGS[name]()
    dlx.save(tmp_path / "thing.dlx", thing)
    again = dlx.load(tmp_path / "thing.dlx")
    assert jax.tree.structure(again) == jax.tree.structure(thing)
    leaves = zip(jax.tree.leaves(thing), jax.tree.leaves(again), strict=True)
    for a, b in leaves:
        assert_same_leaf(a, b)


@once
def test_functools_partial(tmp_path):
    dlx.save(tmp_path / "f", functools.partial(jnp.add, jnp.ones(2)))
    again = dlx.load(tmp_path / "f")
    assert type(again) is functools.partial
    assert_close(again(1.0), 2 * np.ones(2))


@once
def test_what_was_loaded_does_not_compile_again(tmp_path):
    traced = []

    @eqx.filter_jit
    def step(env, x):
        traced.append(None)
        return env.step(0.0, x, jnp.zeros(1)).state

    policy = dlx.controllers.MLP(2, 1, key=KEY)
    act = eqx.filter_jit(lambda policy, y: traced.append(None) or policy(0.0, y, None))
    dlx.save(tmp_path / "pair", (ENV, policy))
    env, loaded = dlx.load(tmp_path / "pair")
    x = jnp.ones(2)
    assert_close(step(env, x), step(ENV, x))
    assert_close(act(loaded, x)[0], act(policy, x)[0])
    assert len(traced) == 2


@once
def test_a_loaded_environment_still_takes_other_parameters(tmp_path):
    dlx.save(tmp_path / "env", ENV)
    longer = dlx.replace(dlx.load(tmp_path / "env"), {"dynamics.system.length": 1.5})
    assert_close(longer.dynamics.system.length, 1.5)
    with user_error(match="length must be positive"):
        dlx.replace(longer, {"dynamics.system.length": -1.0})


@once
def test_static_fields(tmp_path):
    static = Static({"a": (1, "b", None), "f": [double, jnp.tanh, Damper]})
    dlx.save(tmp_path / "static", static)
    again = dlx.load(tmp_path / "static", trust=(__name__,))
    assert again.table == static.table
    assert jax.tree.structure(again) == jax.tree.structure(static)


@once
def test_compiled_functions(tmp_path):
    """What `eqx.filter_jit` makes of a function is found by its name."""
    dlx.save(tmp_path / "f", compiled)
    assert dlx.load(tmp_path / "f", trust=__name__) is compiled


@once
def test_public_names_are_preferred(tmp_path):
    dlx.save(tmp_path / "f", (PENDULUM, jax.nn.relu, diffrax.Tsit5()))
    text = (tmp_path / "f").read_bytes().decode(errors="replace")
    for name in ("delucax.systems:Pendulum", "jax.nn:relu", "diffrax:Tsit5"):
        assert f'"{name}"' in text


# What cannot be written, and where it is.


def local_class():
    class Local(eqx.Module):
        pass

    return Local()


def renamed_method():
    class Other(Damper):
        pass

    return Other().applied


@once
@pytest.mark.parametrize(
    "thing, place, remedy",
    [
        (lambda: lambda x: x, "obj", "top level"),
        (lambda: {"a": [eqx.nn.Lambda(lambda x: x)]}, "obj.a.0.fn", "eqx.Module"),
        (lambda: optax.sgd(0.1), "obj.init", "top level"),
        (lambda: (1, local_class()), "obj.1", "Define the class"),
        (renamed_method, "obj.__self__", "Define the class"),
        (lambda: {1, 2}, "obj", "Use numbers"),
        (lambda: [np.array([None])], "obj.0", "array of numbers"),
        (lambda: np.array(["a"]), "obj", "array of numbers"),
    ],
)
def test_what_has_no_name_fails_at_the_save(thing, place, remedy, tmp_path):
    with user_error(match=rf"save: {place} .*{remedy}"):
        dlx.save(tmp_path / "f", thing())
    assert list(tmp_path.iterdir()) == []


@once
def test_a_name_that_means_another_thing_is_not_written(tmp_path, monkeypatch):
    old = double
    monkeypatch.setattr(sys.modules[__name__], "double", abs)
    with user_error(match="must have a name to import it by"):
        dlx.save(tmp_path / "f", old)


@once
def test_a_lambda_with_a_name_of_its_own(tmp_path):
    dlx.save(tmp_path / "f", halve)
    assert dlx.load(tmp_path / "f", trust=__name__) is halve


@once
def test_traced_values_are_refused(tmp_path):
    def f(x):
        dlx.save(tmp_path / "f", {"x": x})
        return x

    with user_error(match="obj.x is traced by JAX"):
        jax.jit(f)(jnp.ones(2))


# Trust.


@once
def test_own_classes_need_trust(tmp_path):
    dlx.save(tmp_path / "f", Damper(2.0))
    package = __name__.partition(".")[0]
    with user_error(match=rf"is not trusted.*trust=\('{package}',\)"):
        dlx.load(tmp_path / "f")
    for trust in (__name__, (package,), ["other", __name__]):
        assert_close(dlx.load(tmp_path / "f", trust=trust).gain, 2.0)
    with user_error(match="is not trusted"):
        dlx.load(tmp_path / "f", trust=package[:-1])


@once
def test_what_the_script_defines_is_found(tmp_path, monkeypatch):
    main = sys.modules["__main__"]
    for thing in (double, Damper):
        monkeypatch.setattr(thing, "__module__", "__main__")
    monkeypatch.setattr(main, "double", double, raising=False)
    monkeypatch.setattr(main, "Damper", Damper, raising=False)
    dlx.save(tmp_path / "f", (double, Damper(3.0)))
    function, damper = dlx.load(tmp_path / "f")
    assert function is double and type(damper) is Damper
    monkeypatch.delattr(main, "double")
    with user_error(match="'__main__:double', which does not exist.*Define it before"):
        dlx.load(tmp_path / "f")


def forge(path, tree, arrays=()):
    """A file with a right checksum and any content."""
    body = json.dumps({"library": "0", "tree": tree, "arrays": list(arrays)}) + "\n"
    digest = hashlib.sha256(body.encode()).hexdigest()
    path.write_text(f"delucax-file 1 {digest}\n{body}")
    return path


@once
@pytest.mark.parametrize(
    "name",
    [
        "os:system",
        "builtins:eval",
        "subprocess:run",
        "numpy:load",
        "numpy:os.system",
        "numpy.testing:runstring",
        "jax:os.system",
        "jax.tools.jax_to_ir:main",
        "delucax._module._serialise:os.replace",
        "delucax._module._serialise:Path",
        "__main__:sys.exit",
        "equinox._module._prebuilt:Any",
        "delucax.dynamics:Discretized.__init__.__globals__",
    ],
)
def test_a_file_cannot_reach_beyond_what_is_trusted(name, tmp_path):
    with user_error(match="cannot be used: it needs"):
        dlx.load(forge(tmp_path / "f", {"name": name}))


@once
def test_a_package_that_is_not_trusted_is_not_imported(tmp_path, monkeypatch):
    (tmp_path / "never_imported.py").write_text("raise RuntimeError('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    path = forge(tmp_path / "f", {"name": "never_imported:f"})
    with user_error(match="is not trusted"):
        dlx.load(path)
    with user_error(RuntimeError, match="^imported$"):
        dlx.load(path, trust="never_imported")


@once
@pytest.mark.parametrize(
    "tree",
    [
        {"module": "delucax:rollout", "fields": {}},
        {"module": "equinox:Module", "fields": {"a": 1}},
        {"namedtuple": "delucax:Trajectory", "fields": {}},
        {"namedtuple": "delucax.environments:Step", "fields": {"state": 1}},
        {"array": 7},
        {"unheard_of": 1},
        {"method": "nothing", "of": {"module": "delucax.costs:PendulumCost"}},
        {"result": "delucax:RESULTS", "value": 0, "items": {"0": "no_such_item"}},
    ],
)
def test_a_forged_structure_is_refused(tree, tmp_path):
    with user_error(match="cannot be used"):
        dlx.load(forge(tmp_path / "f", tree))


# Versions.


@once
def test_a_class_that_has_changed(tmp_path, monkeypatch):
    module = types.ModuleType("changing_module")
    monkeypatch.setitem(sys.modules, "changing_module", module)

    def define(**fields):
        space = {"__module__": "changing_module", "__annotations__": fields}
        module.Thing = type(eqx.Module)("Thing", (eqx.Module,), space)

    define(a=float, b=float)
    dlx.save(tmp_path / "f", module.Thing(1.0, 2.0))
    trust = "changing_module"
    assert dlx.load(tmp_path / "f", trust=trust).b == 2.0
    for fields in ({"a": float}, {"a": float, "b": float, "c": float}):
        define(**fields)
        with user_error(match=r"'changing_module:Thing' has changed .*\['a', 'b'\]"):
            dlx.load(tmp_path / "f", trust=trust)
    del module.Thing
    with user_error(match="may have been renamed or moved"):
        dlx.load(tmp_path / "f", trust=trust)


@once
def test_results_are_kept_by_name(tmp_path):
    """Their numbers change as Diffrax, Lineax and Optimistix add items."""
    dlx.save(tmp_path / "f", dlx.RESULTS.diverged)
    number = int(dlx.RESULTS.diverged._value)
    content = (tmp_path / "f").read_bytes()
    body = content.partition(b"\n")[2].replace(f'"{number}"'.encode(), b'"77"')
    header, _, payload = body.partition(b"\n")
    old = np.array(number, np.int32).tobytes()
    assert payload == old
    body = header + b"\n" + np.array(77, np.int32).tobytes()
    digest = hashlib.sha256(body).hexdigest().encode()
    (tmp_path / "f").write_bytes(b"delucax-file 1 " + digest + b"\n" + body)
    assert dlx.load(tmp_path / "f") == dlx.RESULTS.diverged


@once
def test_a_newer_version(tmp_path):
    dlx.save(tmp_path / "f", 1)
    content = (
        (tmp_path / "f").read_bytes().replace(b"delucax-file 1", b"delucax-file 2")
    )
    (tmp_path / "f").write_bytes(content)
    with user_error(match=rf"{tmp_path}.* has format 2.*formats up to 1.*Update"):
        dlx.load(tmp_path / "f")


# Damage.


@once
def test_every_flipped_byte_is_noticed(tmp_path):
    dlx.save(tmp_path / "f", {"x": jnp.arange(3.0)})
    content = (tmp_path / "f").read_bytes()
    for i in range(len(content)):
        flipped = bytearray(content)
        flipped[i] ^= 1
        (tmp_path / "f").write_bytes(flipped)
        with user_error(match="damaged|must be a file from|formats up to"):
            dlx.load(tmp_path / "f")


@once
@pytest.mark.parametrize("content", [b"", b"\n", b"\x89PNG\r\n", b"delucax-file 1"])
def test_foreign_files(content, tmp_path):
    (tmp_path / "f").write_bytes(content)
    with user_error(match=f"'{tmp_path / 'f'}' must be a file from delucax.save"):
        dlx.load(tmp_path / "f")


@once
def test_truncated_files(tmp_path):
    dlx.save(tmp_path / "f", jnp.ones(100))
    content = (tmp_path / "f").read_bytes()
    for size in range(0, len(content), 37):
        (tmp_path / "f").write_bytes(content[:size])
        with user_error(match="damaged|must be a file from"):
            dlx.load(tmp_path / "f")


@once
def test_paths(tmp_path):
    with user_error(FileNotFoundError, match=str(tmp_path / "missing")):
        dlx.load(tmp_path / "missing")
    with user_error(match=f"must be the path of a file, got the folder '{tmp_path}'"):
        dlx.load(tmp_path)
    with user_error(match=f"must be the path of a file, got the folder '{tmp_path}'"):
        dlx.save(tmp_path, 1)
    with user_error(FileNotFoundError, match="no_folder.*cannot be written"):
        dlx.save(tmp_path / "no_folder" / "f", 1)
    (tmp_path / "file").touch()
    with user_error(NotADirectoryError, match="file.*cannot be written"):
        dlx.save(tmp_path / "file" / "f", 1)
    dlx.save(str(tmp_path / "text"), 1)
    assert dlx.load(str(tmp_path / "text")) == 1


@pytest.mark.skipif(os.getuid() == 0, reason="the superuser writes everywhere")
def test_a_folder_that_cannot_be_written_to(tmp_path):
    folder = tmp_path / "read_only"
    folder.mkdir(mode=0o500)
    with user_error(PermissionError, match="read_only"):
        dlx.save(folder / "f", 1)


@once
def test_the_old_file_survives_a_failed_write(tmp_path, monkeypatch):
    dlx.save(tmp_path / "f", 1)

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with user_error(OSError, match="cannot be written: .*No space left"):
        dlx.save(tmp_path / "f", 2)
    assert dlx.load(tmp_path / "f") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["f"]


@once
def test_the_file_is_readable_as_any_other(tmp_path):
    (tmp_path / "other").touch()
    dlx.save(tmp_path / "f", 1)
    modes = {(tmp_path / name).stat().st_mode for name in ("f", "other")}
    assert len(modes) == 1


# Precision.


@needs_x64
def test_single_precision_stays_single(tmp_path):
    dlx.save(tmp_path / "f", jnp.ones(2, jnp.float32))
    assert dlx.load(tmp_path / "f").dtype == jnp.float32


@needs_x32
def test_double_precision_is_narrowed_with_a_warning(tmp_path):
    about = [{"dtype": "float64", "shape": []}, {"dtype": "int64", "shape": []}]

    def write(tree, number=3):
        text = json.dumps({"tree": tree, "arrays": about}).encode() + b"\n"
        body = text + np.float64(0.1).tobytes() + np.int64(number).tobytes()
        digest = hashlib.sha256(body).hexdigest().encode()
        (tmp_path / "f").write_bytes(b"delucax-file 1 " + digest + b"\n" + body)

    write({"array": 0})
    with pytest.warns(UserWarning, match="double precision.*jax_enable_x64"):
        x = dlx.load(tmp_path / "f")
    assert x.dtype == jnp.float32 and x == np.float32(0.1)
    write({"weak": 0})  # follows the precision of what it meets, so says nothing
    x = dlx.load(tmp_path / "f")
    assert x.weak_type and x.dtype == jnp.float32
    write({"array": 1})
    assert dlx.load(tmp_path / "f") == 3
    write({"array": 1}, 2**40)
    with user_error(match="whole numbers that need 64 bits"):
        dlx.load(tmp_path / "f")
    write({"numpy": 0})
    assert dlx.load(tmp_path / "f").dtype == np.float64


@once
@pytest.mark.parametrize(
    "call, match",
    [
        (lambda: dlx.save(3, jnp.ones(1)), "save: path must be the path of a file"),
        (lambda: dlx.load(None), "load: path must be the path of a file, got None"),
        (lambda: dlx.load("a.dlx", trust=3), "trust must be the names of packages"),
    ],
)
def test_wrong_kinds_of_argument(call, match):
    with user_error(match=match):
        call()


@once
@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
def test_a_link_and_the_mode_of_a_file_stay(tmp_path):
    path, link = tmp_path / "real.dlx", tmp_path / "link.dlx"
    path.write_bytes(b"")
    path.chmod(0o600)
    link.symlink_to(path)
    dlx.save(link, PENDULUM)
    assert link.is_symlink() and path.stat().st_mode & 0o777 == 0o600
    assert dlx.load(path).length == PENDULUM.length
