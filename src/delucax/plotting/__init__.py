"""Matplotlib views of trajectories, animations and phase portraits.

Needs the extra: `pip install "delucax[plot]"`. Figures are made without pyplot, so none
is kept alive, no backend is chosen and no global setting is changed.
"""

from .._extras import extra


extra("matplotlib", "plot")

from ._animate import animate as animate, Animation as Animation
from ._drawings import register_drawing as register_drawing
from ._phase import phase_portrait as phase_portrait
from ._plot import plot as plot
