"""The C of the page on deployment."""

import re
import shlex
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from helpers import needs_compiler

import delucax as dlx
from delucax.export._compiler import find_compiler


PAGE = Path(__file__).parents[2] / "docs" / "deploy.md"
# What the reader of the page writes: the measurements come from the standard input.
PROGRAM = """
#include <stdio.h>
#include <stdlib.h>
{includes}
static void wait_for_next_sample(void) {{}}
static double seconds(void) {{ return 0.0; }}
static void measure(float *y) {{ if (scanf("%f %f", y, y + 1) != 2) exit(0); }}
static void report(int flag) {{ printf("flag %d\\n", flag); }}
static void apply(const float *u) {{ printf("%.9g\\n", u[0]); }}
int main(void) {{
{loop}
}}
"""


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE.read_text(), re.S | re.M)


@needs_compiler
def test_the_loop_of_the_page_controls_as_python_does(tmp_path):
    env = dlx.make("pendulum")
    model = dlx.linearize(env.dynamics)
    law = dlx.controllers.LQR(model, jnp.diag(jnp.array([10.0, 1.0])), 0.1 * jnp.eye(1))
    dlx.export.c(law, tmp_path / "build/lqr", name="lqr", dtype="float32")

    (code,) = blocks("c")
    includes = "\n".join(re.findall("^#include.*$", code, re.M))
    loop = re.sub("^#include.*$", "", code, flags=re.M)
    (tmp_path / "main.c").write_text(PROGRAM.format(includes=includes, loop=loop))
    _, *options = shlex.split(blocks("sh")[0])
    command = [*find_compiler(None, "test"), *options, "-Wall", "-Werror"]
    subprocess.run(command, cwd=tmp_path, check=True)

    run = dlx.rollout(env, law, key=jax.random.key(0), x0=[0.5, 0.0], horizon=50)
    measured = "\n".join(f"{a:.9g} {b:.9g}" for a, b in run.states[:-1])
    told = subprocess.run(
        [tmp_path / "main"], input=measured, capture_output=True, text=True, check=True
    )
    applied = np.array(told.stdout.split(), float)
    np.testing.assert_allclose(applied, run.controls[:, 0], rtol=1e-5, atol=1e-5)
    assert np.abs(applied).max() == 2.0  # the first controls are at the bound
