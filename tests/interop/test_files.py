"""Linear models from files."""

import control
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
from helpers import assert_close, once, user_error
from scipy.io import savemat

import delucax as dlx
from delucax.interop import from_control, read_linear


A = np.array([[0.0, 1.0], [-2.0, -0.3]])
B = np.array([[0.0], [1.5]])
C = np.array([[1.0, 0.5]])
SAVE = {".npz": lambda path, held: np.savez(path, **held), ".mat": savemat}


@pytest.fixture(params=SAVE)
def written(request, tmp_path):
    def write(**held):
        path = tmp_path / f"plant{request.param}"
        SAVE[request.param](path, held)
        return path

    return write


def test_models_are_read(written):
    model = read_linear(written(A=A, B=B, C=C, E=B, D=np.zeros((1, 1)), dt=0.25))
    assert isinstance(model, dlx.LinearDynamics)
    assert_close(model.dt, 0.25)
    for found, held in ((model.A, A), (model.B, B), (model.C, C), (model.E, B)):
        assert_close(found, held, rtol=1e-6)
    assert found.dtype == jnp.zeros(()).dtype


def test_time_is_what_the_file_or_the_caller_says(written):
    path = written(A=A, B=B)
    flow = read_linear(str(path), dt=0)
    assert isinstance(flow, dlx.systems.LinearSystem) and flow.C is None
    assert_close(read_linear(path, dt=0.5).dt, 0.5)
    with user_error(match="holds no dt; give it: 0 for continuous time"):
        read_linear(path)
    path = written(A=A, B=B, dt=0.0)
    assert isinstance(read_linear(path), dlx.systems.LinearSystem)
    with user_error(match=r"dt must be 0.0, the one in .*, or left out, got 0.1"):
        read_linear(path, dt=0.1)


@once
def test_files_that_do_not_fit(written, tmp_path):
    with user_error(match="must hold A and B, got A, dt"):
        read_linear(written(A=A, dt=1.0))
    with user_error(match="D must be zero"):
        read_linear(written(A=A, B=B, D=[[1.0]], dt=1.0))
    with user_error(match="B must have as many rows as A"):
        read_linear(written(A=A, B=C, dt=1.0))
    with user_error(match="path must end in .npz or .mat, got 'plant.csv'"):
        read_linear("plant.csv")
    for name in ("none.npz", "none.mat"):
        with user_error(FileNotFoundError, match=f"path must be a file, got .*{name}"):
            read_linear(tmp_path / name)
    with user_error(match="A must be real, but is complex in the file"):
        read_linear(written(A=np.diag([1j, -1j]), B=B, dt=1.0))
    savemat(tmp_path / "sparse.mat", {"A": scipy.sparse.csc_matrix(A), "B": B})
    assert_close(read_linear(tmp_path / "sparse.mat", dt=0).A, A, atol=1e-7)
    with user_error(match="read_linear: path must be the path of a file, got 3"):
        read_linear(3)


def test_a_control_object_is_a_task(key):
    there = control.ss(A, B, C, 0, inputs=["force"])
    env = dlx.make("lds", system=from_control(there), dt=0.1)
    assert env.observation_size == 1
    theirs = there.sample(0.1)
    assert_close(env.dynamics.A, theirs.A, rtol=1e-5, atol=1e-7)
    assert_close(env.dynamics.B, theirs.B, rtol=1e-5, atol=1e-7)
    assert env.dynamics.control_names == ("force",)
    run = dlx.rollout(env, dlx.controllers.Zero(1), key=key, horizon=5)
    assert run.observations.shape == (5, 1)
