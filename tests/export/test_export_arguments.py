"""What cannot be written in C, and wrong arguments: errors, and no file."""

import re
import subprocess

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c_programs import exported, STRICT
from helpers import needs_compiler, needs_x64, once
from jax import lax

import delucax as dlx
from delucax import export
from delucax.export._compiler import find_compiler


ONES = np.ones(3)


def callback(x):
    return jax.pure_callback(lambda x: x, x, x)


def endless(x):
    return lax.while_loop(lambda y: jnp.sum(y) < 99, lambda y: 2 * y, x)


def printed(x):
    jax.debug.print("{}", x)
    return x


def total(a, b):
    return a + b + a * b


def filtered(x):
    return eqx.filter_pure_callback(lambda x: x, x, result_shape_dtypes=x)


REFUSED = [
    ("eigh", lambda x: jnp.linalg.eigvalsh(jnp.outer(x, x)), "eigenvalues"),
    ("svd", lambda x: jnp.linalg.svd(jnp.outer(x, x))[1], "singular values"),
    ("pure_callback", callback, "C cannot call Python"),
    ("pure_callback", filtered, "C cannot call Python"),
    ("debug_print", printed, "C cannot call Python"),
    ("while_loop", endless, "give max_iterations"),
    (
        "random_seed",
        lambda x: jax.random.normal(jax.random.key(x[0].astype(int))),
        "random numbers",
    ),
    (
        "random_bits",
        lambda x: jax.random.normal(x.astype(jnp.uint32)[:2]),
        "random numbers",
    ),
    ("convert_element_type", lambda x: jnp.fft.fft(x).real, "no type for complex"),
    ("igamma", lambda x: jax.scipy.special.gammainc(x, x), "not implemented in C"),
    (
        "reduce",
        lambda x: lax.reduce(x, x.dtype.type(0), total, (0,)),
        "not implemented in C",
    ),
    (
        "reduce_window",
        lambda x: lax.reduce_window(x, x.dtype.type(0), total, (2,)),
        "not implemented in C",
    ),
]


@once
@pytest.mark.parametrize(("name", "function", "why"), REFUSED)
def test_refusal_names_the_operation_and_the_line(tmp_path, name, function, why):
    with pytest.raises(ValueError, match=why) as error:
        export.c(function, tmp_path, name="f", example=(ONES,))
    pattern = rf"export\.c: {name} at test_export_arguments\.py:\d+ cannot be exported"
    assert re.search(pattern, str(error.value)), error.value
    assert not any(tmp_path.iterdir())


PLANT = dlx.LinearDynamics([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], dt=0.1)
LAW = dlx.controllers.Linear(jnp.array([[1.0, 2.0]]))


@once
@pytest.mark.parametrize(
    ("given", "words"),
    [
        (dict(name="1st"), "name must be an identifier in C"),
        (dict(name="while"), "name must be an identifier in C"),
        (dict(name="sin"), "name must be an identifier in C"),
        (dict(name="sinf"), "name must be an identifier in C"),
        (dict(name="malloc"), "name must be an identifier in C"),
        (dict(name="a b"), "name must be an identifier in C"),
        (dict(name=3), "name must be an identifier in C"),
        (dict(dtype="float16"), "dtype must be 'float32' or 'float64'"),
        (dict(example=np.zeros((2, 2))), "example must be an observation"),
        (dict(fallback=[1.0, 2.0]), "fallback must"),
        (dict(fallback=[np.nan]), "fallback must"),
        (dict(key=3), "key must be one random key"),
        (
            dict(
                function_or_controller=jnp.sin, example=(ONES,), key=jax.random.key(0)
            ),
            "key is given",
        ),
        (dict(max_iterations=0), "max_iterations must be a whole number"),
        (dict(directory=3), "directory must be the path"),
        (dict(function_or_controller=3), "function_or_controller must be"),
        (dict(function_or_controller=jnp.sin), "example must be a tuple"),
        (
            dict(function_or_controller=jnp.sin, example=("a",)),
            r"example\[0\] must be of real numbers",
        ),
        (
            dict(function_or_controller=jnp.sin, example=(jax.random.key(0),)),
            r"example\[0\] must be an array, a number or",
        ),
        (
            dict(function_or_controller=lambda x: "a", example=(ONES,)),
            "the function must return arrays and numbers, got 'a'",
        ),
        (
            dict(function_or_controller=jnp.sin, example=(ONES,), fallback=[0.0]),
            "fallback is given",
        ),
        (
            dict(function_or_controller=dlx.systems.Pendulum(), example=(ONES,)),
            "example is given",
        ),
        (
            dict(function_or_controller=dlx.controllers.Zero(1)),
            "size of the observation is not known from this controller",
        ),
    ],
)
def test_wrong_arguments(tmp_path, given, words):
    options = dict(function_or_controller=LAW, directory=tmp_path, name="law") | given
    with pytest.raises(ValueError, match=words):
        export.c(**options)
    assert not any(tmp_path.iterdir())


@once
def test_a_plant_gives_the_size_of_an_observation(tmp_path):
    total = dlx.controllers.Constant([1.0])
    export.c(total, tmp_path, name="held", plant=PLANT)
    header = (tmp_path / "held.h").read_text()
    assert f"HELD_OBSERVATION_SIZE {PLANT.observation_size}" in header


@once
def test_no_half_written_files(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="directory must be one that can be written"):
        export.c(LAW, tmp_path / "file", name="law")
    (tmp_path / "law.c").mkdir()
    with pytest.raises(ValueError, match="directory must be one that can be written"):
        export.c(LAW, tmp_path, name="law")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "law.c"]


@once
def test_report_and_header(tmp_path):
    plant = dlx.Discretized(dlx.systems.CartPole(), dt=0.02)
    export.c(plant, tmp_path, name="plant", dtype="float32")
    header = (tmp_path / "plant.h").read_text()
    assert "x[2]: angle [rad]" in header
    assert "u[0]: force [N]" in header
    report = export.c(endless, tmp_path, name="loop", example=(ONES,), max_iterations=8)
    ((line, rounds),) = report.bounds
    assert line.startswith("test_export_arguments.py:")
    assert rounds == 8
    cost = dlx.costs.Quadratic(jnp.eye(2), 0.1 * jnp.eye(1))
    mpc = dlx.controllers.MPC(PLANT, cost, 3)
    ours = export.c(mpc, tmp_path, name="mpc").bounds
    assert ours[0][0].endswith("_descent.py, optimise")
    assert "8 rounds" in repr(report)
    assert report.constants == report.state == 0
    # A round is at least two products and the sum of the test.
    assert 8 * 4 <= report.operations <= 8 * 20


def chained(x, k):
    """Loops, branches, indices that lie outside, and factors."""

    def body(y, row):
        y = y.at[k].add(row[0])
        y = lax.cond(y[0] > 0, jnp.sin, lambda y: y * 2, y)
        return jnp.roll(y, 1), lax.dynamic_slice(y, (k,), (3,))

    y, rows = lax.scan(body, x[0], x)
    inverse = jnp.linalg.inv(x @ x.T + jnp.eye(x.shape[0]))
    short = (k * 9999).astype(jnp.int16)
    wrapped = (k * 2**30) // 3 + (k * 99999) ** 5 + short * short * short + short**3
    return y, rows, inverse, x[k], jnp.sort(x), wrapped


@needs_x64
@needs_compiler
def test_sanitizers_find_nothing(tmp_path):
    x = np.random.default_rng(0).normal(size=(4, 6))
    cost = dlx.costs.Quadratic(jnp.eye(2), 0.1 * jnp.eye(1))
    mpc = dlx.controllers.MPC(PLANT, cost, 15, bounds=(-1.0, 1.0), real_time=True)
    export.c(chained, tmp_path, name="chained", example=(x, 0), dtype="float64")
    export.c(mpc, tmp_path, name="mpc", dtype="float64")
    numbers = ", ".join(map(repr, x.ravel().tolist()))
    (tmp_path / "main.c").write_text(
        f"""
        #include "chained.h"
        #include "mpc.h"
        int main(void) {{
          const double x[24] = {{{numbers}}};
          double a[6], b[12], c[16], d[6], e[24], y[2] = {{1, 0}}, u[1];
          {exported_type(tmp_path)} f[1];
          mpc_state state;
          for (int k = -9; k < 9; ++k)
            if (chained(x, k, a, b, c, d, e, f)) return 1;
          mpc_init(&state);
          for (int k = 0; k < 120; ++k) {{
            if (mpc_step(&state, 0.1 * k, y, u)) return 2;
            mpc_applied(&state, u, 0.0);
            y[0] += 0.1 * y[1];
            y[1] += 0.1 * u[0];
          }}
          return y[0] * y[0] + y[1] * y[1] < 0.01 ? 0 : 3;
        }}
        """
    )
    options = [*STRICT, "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover"]
    files = [str(tmp_path / f"{name}.c") for name in ("main", "chained", "mpc")]
    program = str(tmp_path / "program")
    command = [*find_compiler(None, ""), *options, "-o", program, *files, "-lm"]
    subprocess.run(command, check=True)
    ran = subprocess.run([program], capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, "")


def exported_type(folder):
    """The type of the whole numbers, which is that of the process."""
    return "int64_t" if "int64_t *" in (folder / "chained.h").read_text() else "int32_t"


@once
@needs_compiler
def test_parts_of_a_pytree_are_arguments(tmp_path):
    env = dlx.make("pendulum", dt=0.05)
    noise = 1e-3 * jnp.eye(2), 1e-2 * jnp.eye(2)
    ekf = dlx.estimators.ExtendedKalmanFilter(env.dynamics, *noise)
    belief, y = ekf.init(), np.array([0.1, -0.2])
    update = exported(tmp_path, {"update": (ekf.update, (0.0, y, belief))})["update"]
    about = export.load(tmp_path).description
    names = [a.name for a in about.inputs]
    assert names == ["t", "y", "state_mean", "state_covariance"]
    expected = jax.tree.leaves(ekf.update(0.0, jnp.asarray(y), belief))
    flag, found = update(0.0, y, *jax.tree.leaves(belief))
    assert flag == 0
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)
