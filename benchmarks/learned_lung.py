"""`python -m benchmarks.learned_lung`: the lung of the task `lung/learned_lung`.

Explores the task `lung/double_compartment` (R = C = 20), fits a `LearnedLung` to 400
breaths as the ventilator study does, and prints its open-loop error on 400 others,
beside that of the lung that comes with the library, which was made so. Writes it to
`build/learned_lung.dlx`. The keys are fixed; another machine may round otherwise.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax

import delucax as dlx
from benchmarks._machine import compile_anew
from delucax import lung
from delucax.studies.ventilator._stages import FULL


BREATHS = 400
SIZES: Any = dict(u_window=6, p_window=3)
"""Short windows: the state has 13 numbers."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description="The lung of the task lung/learned_lung."
    )
    parser.add_argument("--out", default="build/learned_lung.dlx", help="file to write")
    out = Path(parser.parse_args().out)
    out.parent.mkdir(parents=True, exist_ok=True)
    env = lung.double_compartment()
    train = lung.explore(env, BREATHS, key=jax.random.key(0))
    test = lung.explore(env, BREATHS, key=jax.random.key(100))
    compile_anew()
    begin = time.perf_counter()
    model = lung.LearnedLung(train, key=jax.random.key(1), **SIZES)
    steps: Any = dict(teacher_steps=FULL.teacher_steps, steps=FULL.simulator_steps)
    model = lung.fit_lungs(model, train, key=jax.random.key(2), **steps).model
    seconds = time.perf_counter() - begin
    shipped: Any = lung.learned_lung().dynamics.dynamics  # pyright: ignore
    error = eqx.filter_jit(test.open_loop_error)
    print(f"learned here, in {seconds:.0f} s: {error(model):.4f} cmH2O")
    print(f"that of the library: {error(shipped):.4f} cmH2O")
    dlx.save(out, model)
    print(f"written: {out}")


if __name__ == "__main__":
    main()
