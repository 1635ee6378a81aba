"""Analysis of linear models: poles, zeros, Gramians, norms and margins. Periodic orbits
of hybrid systems."""

from ._disk_margin import disk_margin as disk_margin, DiskMargin as DiskMargin
from ._gains import (
    dcgain as dcgain,
    frequency_response as frequency_response,
    h2_norm as h2_norm,
    hinf_norm as hinf_norm,
    PeakGain as PeakGain,
)
from ._gramians import (
    controllability_gramian as controllability_gramian,
    controllability_matrix as controllability_matrix,
    observability_gramian as observability_gramian,
    observability_matrix as observability_matrix,
)
from ._margins import Margins as Margins, margins as margins
from ._modes import (
    is_controllable as is_controllable,
    is_detectable as is_detectable,
    is_observable as is_observable,
    is_stabilizable as is_stabilizable,
    modal_controllability as modal_controllability,
    modal_observability as modal_observability,
    ModalTest as ModalTest,
    poles as poles,
)
from ._orbits import (
    periodic_orbit as periodic_orbit,
    PeriodicOrbit as PeriodicOrbit,
    poincare_map as poincare_map,
    Return as Return,
)
from ._zeros import zeros as zeros
