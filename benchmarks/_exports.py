"""What `benchmarks.export` exports, and how its C is built and run."""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import delucax as dlx
from benchmarks._embedded import call, write_headers
from delucax import lung


ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from controllers_catalogue import CASES, DT  # noqa: E402


STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror")
SANITIZED = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
QUICK = ("-std=c99", "-O2")
PEERS = Path(__file__).parent / "_peers"
STEPS = PEERS / "steps.c"
KEY = jax.random.key(0)
"""Of the draws of all controllers."""


class Exported(NamedTuple):
    """A controller to export.

    - `make`: the controller.
    - `observations`: the size of an observation.
    - `dt`: the time between steps.
    - `scale`: of the observations that are drawn.
    - `iterates`: whether its answer is that of iterations, which end at a tolerance: by
        default the square root of the precision.
    """

    make: Callable[[], Any]
    observations: int = 2
    dt: float = DT
    scale: float = 1.0
    iterates: bool = False


def lqr() -> Any:
    """The regulator of a cart-pole: four states."""
    env = dlx.make("cartpole_linear")
    weights = jnp.diag(jnp.array([1.0, 0.1, 10.0, 0.1])), 0.1 * jnp.eye(1)
    return dlx.controllers.LQR(env.dynamics, *weights)


def mlp() -> Any:
    """A network with two layers of 32."""
    return dlx.controllers.MLP(4, 1, width=32, depth=2, key=jax.random.key(0))


def pendulum_mpc(**options: Any) -> Any:
    """MPC of the pendulum."""
    env = dlx.make("pendulum", dt=0.02)
    cost = dlx.costs.Quadratic([1.0, 0.1], [0.1], final=[20.0, 5.0])
    given = dict(bounds=(-2.0, 2.0), throw=False) | options
    return dlx.controllers.MPC(env.dynamics, cost, 20, **given)


def breath(inspiratory: Callable[[Any], Any]) -> Any:
    """A ventilator's controller with its waveform."""
    waveform = lung.BreathWaveform()
    return lung.Breathing(inspiratory(waveform), waveform)


def breath_pid() -> Any:
    """The ventilator's PID."""
    made = lambda wave: dlx.controllers.PID(1.0, 3.0, dt=0.03, reference=wave)
    return breath(made)


def breath_network() -> Any:
    """The ventilator's network."""
    policy = lambda wave: lung.BreathPolicy(wave, 0.03, key=jax.random.key(3))
    return breath(policy)


ITERATING = {"MPC", "SafetyFilter in steps", "OutputFeedback of a moving horizon"}
OURS = {
    "LQR of four states": Exported(lqr, 4, 0.02, 0.1),
    "MLP, two layers of 32": Exported(mlp, 4, 0.02),
    "MPC of the pendulum": Exported(pendulum_mpc, 2, 0.02, 0.3, True),
    "MPC of the pendulum, real time": Exported(
        lambda: pendulum_mpc(real_time=True), 2, 0.02, 0.3, True
    ),
    "ventilator, PID": Exported(breath_pid, 1, 0.03, 10.0),
    "ventilator, network": Exported(breath_network, 1, 0.03, 10.0),
}
ALL = OURS | {
    name: Exported(lambda case=case: case.make(1.0), iterates=name in ITERATING)
    for name, case in CASES.items()
}
ON_THE_BOARD = (*OURS, "LQI", "LQG", "HInfinity", "PID", "GRU", "Scheduled")
ON_THE_BOARD += ("FiniteHorizonLQR", "OutputFeedback", "GPC", "BPC", "SafetyFilter")


def write(
    case: Exported, folder: Path, name: str = "law", dtype: str | None = None
) -> Path:
    """The C file of a case."""
    example = jnp.zeros(case.observations)
    options = dict(name=name, dtype=dtype, example=example, key=KEY)
    dlx.export.c(case.make(), folder, **options)
    return folder / f"{name}.c"


def table(case: Exported, rows: int, controls: int, seed: int = 0) -> np.ndarray:
    """Rows of time, observation, control that was applied, and cost."""
    rng = np.random.default_rng(seed)
    t = case.dt * np.arange(rows)[:, None]
    y = case.scale * rng.normal(size=(rows, case.observations))
    u, cost = rng.normal(size=(rows, controls)), rng.normal(size=(rows, 1)) ** 2
    return np.concatenate([t, y, u, cost], axis=1).astype(jnp.zeros(()).dtype)


def build(
    source: Path, rows: np.ndarray, *flags: str, rounds: int = 1, times: int = 1
) -> str:
    """What `steps.c` prints of a controller over a table, built with these flags."""
    name = source.stem
    with tempfile.TemporaryDirectory() as inside:
        folder = Path(inside)
        write_headers(folder, name, rows)
        options = f"-DNAME={name}", f"-DROUNDS={rounds}", f"-DTIMES={times}"
        where = f"-I{folder}", f"-I{source.parent}"
        program = folder / "steps"
        call("cc", *flags, *options, *where, STEPS, source, "-o", program, "-lm")
        return call(program)


def nanoseconds(source: Path, rows: np.ndarray, times: int, rounds: int = 21) -> float:
    """Nanoseconds a step at `-O2`."""
    return float(build(source, rows, *QUICK, rounds=rounds, times=times).split()[0])


def undefined(source: Path, folder: Path) -> set[str]:
    """The symbols that its object needs; raises if a strict compiler objects."""
    made = folder / f"{source.stem}.o"
    call("cc", *STRICT, "-O2", "-c", source, "-o", made)
    return {line.split()[-1] for line in call("nm", "-u", made).splitlines()}


def by_hand(folder: Path, **numbers: Any) -> Path:
    """The C file of a controller by hand: a gain `K`, or a network's `W0`, `b0` on."""
    first = np.atleast_2d(numbers.get("K", numbers.get("W0")))
    controls = len(first) if "K" in numbers else len(numbers["b2"])
    lines = [
        "#ifndef BY_HAND_H",
        "#define BY_HAND_H",
        f"#define OBSERVATIONS {first.shape[1]}",
        f"#define CONTROLS {controls}",
        "#define BY_HAND_OBSERVATION_SIZE OBSERVATIONS",
        "#define BY_HAND_CONTROL_SIZE CONTROLS",
        "typedef double real;",
        "typedef double by_hand_real;",
        "typedef struct { real last[CONTROLS]; } by_hand_state;",
        "void by_hand_init(by_hand_state *state);",
        "int by_hand_step(by_hand_state *state, real t, const real *y, real *u);",
        "void by_hand_applied(by_hand_state *state, const real *u, real cost);",
    ]
    if "W0" in numbers:
        lines += ["#define LAYERS", f"#define WIDTH {len(first)}"]
    (folder / "by_hand.h").write_text("\n".join([*lines, "#endif", ""]))
    constants = [
        f"static const real {name}[] = {{{', '.join(map(repr, flat))}}};"
        for name, value in numbers.items()
        for flat in [np.ravel(np.asarray(value, float)).tolist()]
    ]
    source = (PEERS / "by_hand.c").read_text()
    head = '#include "by_hand.h"\n'
    target = folder / "by_hand.c"
    target.write_text(source.replace(head, head + "\n" + "\n".join(constants) + "\n"))
    return target
