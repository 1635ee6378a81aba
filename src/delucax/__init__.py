"""Differentiable control in continuous time.

Write a system `dx/dt = f(t, x, u, w)` as a module, let Diffrax integrate it, and close
the loop with a controller. You can differentiate, `vmap` and `jit` the whole loop.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING

from ._lazy import lazily as _lazily


if TYPE_CHECKING:
    from . import (
        analysis as analysis,
        controllers as controllers,
        costs as costs,
        disturbances as disturbances,
        dynamics as dynamics,
        environments as environments,
        estimators as estimators,
        experiments as experiments,
        export as export,
        interop as interop,
        lung as lung,
        math as math,
        planning as planning,
        plotting as plotting,
        problems as problems,
        qp as qp,
        references as references,
        riccati as riccati,
        simulation as simulation,
        studies as studies,
        systems as systems,
        training as training,
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
    from .plotting import animate as animate, plot as plot
    from .simulation import (
        rollout as rollout,
        simulate as simulate,
        Trajectory as Trajectory,
    )
    from .systems import AbstractSystem as AbstractSystem, system as system

    __version__: str
del TYPE_CHECKING

_PACKAGES = """
    analysis controllers costs disturbances dynamics environments estimators experiments
    export interop lung math planning plotting problems qp references riccati simulation
    studies systems training
""".split()
_name, _names = _lazily(
    __name__,
    {
        "_controller": "AbstractController AbstractLearner AbstractStochasticPolicy",
        "_module": "bounded load parameter positive replace save weight",
        "_results": "RESULTS",
        "costs": "AbstractCost",
        "disturbances": "AbstractDisturbance",
        "dynamics": "AbstractDynamics c2d d2c Discretized LinearDynamics linearize"
        " open_loop trim",
        "environments": "Environment make randomise register",
        "plotting": "animate plot",
        "simulation": "rollout simulate Trajectory",
        "systems": "AbstractSystem system",
    },
)


def __getattr__(name: str):
    """Packages and names, imported at first use, so that the command line starts
    quickly."""
    if name == "__version__":
        from importlib.metadata import version

        return version("delucax")
    if name in _PACKAGES:
        return _import_module(f".{name}", __name__)
    return _name(name)


def __dir__() -> list[str]:
    return sorted({*_names(), *_PACKAGES})
