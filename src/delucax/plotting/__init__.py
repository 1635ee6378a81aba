"""Plots of trajectories, animations and phase portraits, with Matplotlib.

They need an extra: `pip install "delucax[plot]"`. Figures are made without pyplot, so
no figure is kept alive, no backend is chosen and no global setting is changed.
"""

try:
    import matplotlib  # noqa: F401
except ImportError as error:
    raise ImportError(
        "delucax.plotting needs matplotlib, which is an optional extra: "
        'pip install "delucax[plot]"'
    ) from error

from ._animate import animate as animate
from ._drawings._registry import register_drawing as register_drawing
from ._phase import phase_portrait as phase_portrait
from ._plot import plot as plot
from ._renderer import Renderer as Renderer
