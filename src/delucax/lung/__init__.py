"""Ventilators: lungs, breath waveforms, learned lung models and controllers."""

from typing import TYPE_CHECKING

from .._lazy import lazily as _lazily
from .._module import stack as stack, unstack as unstack
from ._breath_controllers import (
    BangBang as BangBang,
    Breathing as Breathing,
    BreathPolicy as BreathPolicy,
)
from ._breath_file import read_breaths as read_breaths, write_breaths as write_breaths
from ._breaths import Breaths as Breaths
from ._learned_lung import LearnedLung as LearnedLung
from ._lung_models import (
    GreyBoxLung as GreyBoxLung,
    LungModel as LungModel,
    NeuralLung as NeuralLung,
)
from ._lung_tasks import (
    balloon_lung as balloon_lung,
    delay_lung as delay_lung,
    double_compartment as double_compartment,
    learned_lung as learned_lung,
    single_compartment as single_compartment,
)
from ._lungs import (
    AbstractLung as AbstractLung,
    BalloonLung as BalloonLung,
    DelayLung as DelayLung,
    DoubleCompartment as DoubleCompartment,
    SingleCompartment as SingleCompartment,
)
from ._published import (
    Published as Published,
    PublishedController as PublishedController,
    PublishedLung as PublishedLung,
    read_published as read_published,
)
from ._runner import (
    run_breaths as run_breaths,
    Runner as Runner,
    SimulatedRunner as SimulatedRunner,
)
from ._ventilation import (
    BreathCost as BreathCost,
    PressureSensor as PressureSensor,
    Valves as Valves,
    ventilation as ventilation,
)
from ._waveform import BreathWaveform as BreathWaveform


if TYPE_CHECKING:
    from ._explorer import explore as explore, Explorer as Explorer
    from ._lung_training import (
        breath_error as breath_error,
        fit_lungs as fit_lungs,
        pid_grid as pid_grid,
        train_controllers as train_controllers,
    )
    from ._shooting import least_error as least_error, ShootingMPC as ShootingMPC
else:
    # Controllers, Optax and the training loop are imported when they are first used.
    __getattr__, __dir__ = _lazily(
        __name__,
        {
            "_explorer": "explore Explorer",
            "_lung_training": "breath_error fit_lungs pid_grid train_controllers",
            "_shooting": "least_error ShootingMPC",
        },
    )
del TYPE_CHECKING
