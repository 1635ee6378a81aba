"""The error of `BacksolveAdjoint` against the tolerance of the solve.

`python docs/figures/backsolve.py` draws `docs/assets/backsolve.svg`, which the page on
gradients shows, in about two minutes on two cores.

A damped pendulum under a sinusoidal torque, six seconds in one adaptive solve, in
float64. The loss is the squared norm of the final state; its gradient is taken with
respect to the length and the amplitude of the torque, and compared with that of a solve
by Dopri8 at a tolerance of 1e-13, discretised and then differentiated.
"""

from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.figure import Figure

import delucax as dlx


SECONDS = 6.0
DAMPING = (1.0, 10.0)
TOLERANCES = 10.0 ** np.arange(-3.0, -11.5, -1.0)
ENDS = np.array([0.0, SECONDS])
OFTEN = np.linspace(0.0, SECONDS, 61)
CASES = {
    "RecursiveCheckpointAdjoint": (diffrax.RecursiveCheckpointAdjoint(), ENDS),
    "BacksolveAdjoint, states saved every 0.1 s": (diffrax.BacksolveAdjoint(), OFTEN),
    "BacksolveAdjoint, only the ends saved": (diffrax.BacksolveAdjoint(), ENDS),
}


class Torque(eqx.Module):
    """A sinusoid in time; a module, so that the adjoint sees its amplitude."""

    amplitude: Array

    def __call__(self, t):
        return self.amplitude * jnp.sin(3.0 * t)


def gradient_function(damping, adjoint, save_at, solver=None, **options):
    """The gradient as a function of the tolerance, compiled once."""

    @eqx.filter_jit
    def gradient(tolerance):
        control = diffrax.PIDController(rtol=tolerance, atol=tolerance)

        def loss(theta):
            trajectory = dlx.simulate(
                dlx.systems.Pendulum(length=theta[0], damping=damping),
                Torque(theta[1:]),
                0.0,
                SECONDS,
                jnp.array([2.0, 0.0]),
                hold=None,
                solver=solver,
                stepsize_controller=control,
                adjoint=adjoint,
                ts=save_at,
                **options,
            )
            return jnp.sum(trajectory.final_state**2)

        return jax.grad(loss)(jnp.array([1.0, 3.0]))

    return gradient


def measure():
    """From damping to label to errors; NaN where the backward solve raises."""
    errors = {}
    for damping in DAMPING:
        reference = gradient_function(
            damping, CASES["RecursiveCheckpointAdjoint"][0], ENDS, diffrax.Dopri8()
        )(1e-13)
        errors[damping] = {}
        for label, (adjoint, save_at) in CASES.items():
            gradient = gradient_function(damping, adjoint, save_at)
            column = []
            for tolerance in TOLERANCES:
                try:
                    error = jnp.linalg.norm(gradient(tolerance) - reference)
                    column.append(float(error / jnp.linalg.norm(reference)))
                except RuntimeError:
                    column.append(np.nan)
            errors[damping][label] = np.array(column)
            print(f"damping {damping:g}/s, {label}:", *(f"{e:.1e}" for e in column))
    return errors


def draw(errors, path):
    """Two panels, a line for each way to take the gradient."""
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    looks = {
        label: {"color": color, "marker": marker, "ms": 4, "lw": 1.6}
        for label, color, marker in zip(
            CASES, ("#0072B2", "#009E73", "#D55E00"), "os^", strict=True
        )
    }
    for ax, damping in zip(panels, DAMPING, strict=True):
        for label, column in errors[damping].items():
            ax.loglog(TOLERANCES, column, label=label, **looks[label])
            raises = TOLERANCES[np.isnan(column)]
            style = looks[label] | {"marker": "x", "ms": 6, "ls": "none"}
            ax.plot(raises, np.full(len(raises), 3.0), **style)
        ax.set_title(f"damping {damping:g} / s", fontsize=10)
        ax.set_xlabel("tolerance of the solve")
        ax.minorticks_off()
        ax.invert_xaxis()
        ax.grid(True, color="0.5", alpha=0.2)
        ax.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("relative error of the gradient")
    handles, labels = panels[0].get_legend_handles_labels()
    cross = panels[1].plot([], [], "x", color="#D55E00", ms=6)
    figure.legend(
        handles + cross,
        [*labels, "the backward solve raises"],
        loc="outside lower center",
        ncols=2,
        frameon=False,
    )
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    import matplotlib

    jax.config.update("jax_enable_x64", True)
    matplotlib.rcParams.update(
        {"font.size": 9, "svg.fonttype": "none", "svg.hashsalt": "delucax"}
    )
    draw(measure(), Path(__file__).parents[1] / "assets" / "backsolve.svg")
