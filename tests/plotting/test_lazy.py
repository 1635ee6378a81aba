"""Matplotlib is optional, loaded when it is needed, and used without pyplot."""

import subprocess
import sys
import textwrap

import pytest
from helpers import once

import delucax as dlx


pytestmark = once


def python(code):
    command = [sys.executable, "-c", textwrap.dedent(code)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_import_loads_no_matplotlib_and_drawing_no_pyplot():
    python("""
        import sys
        import delucax as dlx

        assert {"animate", "plot", "plotting"} <= set(dir(dlx))
        assert "matplotlib" not in sys.modules and "PIL" not in sys.modules

        import jax

        env = dlx.make("pendulum")
        zero = dlx.controllers.Zero(1)
        run = dlx.rollout(env, zero, key=jax.random.key(0), horizon=3)
        assert "matplotlib" not in sys.modules

        dlx.plot(run)
        dlx.animate(env, run, max_frames=2)._repr_html_()
        dlx.plotting.phase_portrait(env.dynamics.system, limits=((-1, 1), (-1, 1)))
        assert "matplotlib" in sys.modules
        assert "matplotlib.pyplot" not in sys.modules
    """)


def test_what_is_missing_says_how_to_get_it():
    python("""
        import sys
        sys.modules["matplotlib"] = sys.modules["pandas"] = None
        import delucax as dlx

        for name in ("animate", "plot", "plotting"):
            try:
                getattr(dlx, name)
            except ImportError as error:
                assert 'pip install "delucax[plot]"' in str(error), error
            else:
                raise AssertionError(f"{name} was found")

        try:
            dlx.Trajectory.to_pandas(None)
        except ImportError as error:
            assert 'pip install "delucax[tables]"' in str(error), error
        else:
            raise AssertionError("a table was made")
    """)


def test_names_are_those_of_the_package():
    assert dlx.plot is dlx.plotting.plot
    assert dlx.animate is dlx.plotting.animate
    with pytest.raises(AttributeError, match="has no attribute 'plott'"):
        _ = dlx.plott
