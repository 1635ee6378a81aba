"""Differentiable control in continuous time.

Write `dx/dt = f(t, x, u, w)` as a module, let Diffrax integrate it, close the loop with
a controller, and differentiate, `vmap` or `jit` the whole.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING

from . import (
    costs as costs,
    disturbances as disturbances,
    dynamics as dynamics,
    environments as environments,
    math as math,
    systems as systems,
)
from ._controller import (
    AbstractController as AbstractController,
    AbstractLearner as AbstractLearner,
    AbstractStochasticPolicy as AbstractStochasticPolicy,
)
from ._module import (
    bounded as bounded,
    load as load,
    parameter as parameter,
    positive as positive,
    replace as replace,
    save as save,
    weight as weight,
)
from ._results import RESULTS as RESULTS
from .costs import AbstractCost as AbstractCost
from .disturbances import AbstractDisturbance as AbstractDisturbance
from .dynamics import (
    AbstractDynamics as AbstractDynamics,
    c2d as c2d,
    d2c as d2c,
    Discretized as Discretized,
    LinearDynamics as LinearDynamics,
    linearize as linearize,
    open_loop as open_loop,
    trim as trim,
)
from .environments import (
    Environment as Environment,
    make as make,
    randomise as randomise,
    register as register,
)
from .simulation import (
    rollout as rollout,
    simulate as simulate,
    Trajectory as Trajectory,
)
from .systems import AbstractSystem as AbstractSystem, system as system


if TYPE_CHECKING:
    from . import (
        analysis as analysis,
        controllers as controllers,
        estimators as estimators,
        experiments as experiments,
        interop as interop,
        lung as lung,
        planning as planning,
        plotting as plotting,
        references as references,
        riccati as riccati,
        studies as studies,
        training as training,
    )
    from .plotting import animate as animate, plot as plot

    __version__: str
del TYPE_CHECKING

_LAZY = """
    analysis animate controllers estimators experiments interop lung planning plot
    plotting references riccati studies training
""".split()


def __getattr__(name: str):
    """Packages beyond the core, imported at first use."""
    if name in ("animate", "plot"):
        return getattr(_import_module(".plotting", __name__), name)
    if name == "__version__":
        from importlib.metadata import version

        return version("delucax")
    if name in _LAZY:
        return _import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
