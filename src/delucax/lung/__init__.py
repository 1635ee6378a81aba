"""Lungs, the breath that a ventilator is to make, and controllers that learn to."""

from ._csv import (
    read_breaths as read_breaths,
    write_breaths as write_breaths,
    write_example as write_example,
)
from ._data import (
    Breaths as Breaths,
    explore as explore,
    Explorer as Explorer,
    segment as segment,
    split as split,
)
from ._environment import (
    BreathCost as BreathCost,
    PressureSensor as PressureSensor,
    ventilation as ventilation,
)
from ._fitting import fit_lungs as fit_lungs, open_loop_error as open_loop_error
from ._grid import (
    least_error as least_error,
    pid_grid as pid_grid,
    PIDGrid as PIDGrid,
)
from ._learned import LearnedLung as LearnedLung
from ._lungs import (
    AbstractLung as AbstractLung,
    BalloonLung as BalloonLung,
    DelayLung as DelayLung,
    DoubleCompartment as DoubleCompartment,
    SingleCompartment as SingleCompartment,
)
from ._models import (
    GreyBoxLung as GreyBoxLung,
    LungModel as LungModel,
    NeuralLung as NeuralLung,
)
from ._original import (
    original_valve as original_valve,
    OriginalBalloonLung as OriginalBalloonLung,
    OriginalDelayLung as OriginalDelayLung,
    OriginalSingleCompartment as OriginalSingleCompartment,
)
from ._policies import (
    BangBang as BangBang,
    Breathing as Breathing,
    BreathPolicy as BreathPolicy,
    ExpiratoryValve as ExpiratoryValve,
    FeedForward as FeedForward,
    Summed as Summed,
)
from ._runner import (
    Recording as Recording,
    run_breaths as run_breaths,
    Runner as Runner,
    SimulatedRunner as SimulatedRunner,
)
from ._shooting import ShootingMPC as ShootingMPC
from ._stacking import stack as stack, unstack as unstack
from ._tasks import (
    balloon_lung as balloon_lung,
    delay_lung as delay_lung,
    double_compartment as double_compartment,
    learned_lung as learned_lung,
    single_compartment as single_compartment,
)
from ._train import (
    breath_error as breath_error,
    lung_environment as lung_environment,
    train_controllers as train_controllers,
)
from ._valves import Valves as Valves
from ._waveform import at_pip as at_pip, BreathWaveform as BreathWaveform
