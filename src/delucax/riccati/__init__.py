"""Riccati, Lyapunov and Sylvester equations, solved without eigenvalues."""

from ._algebraic import (
    care as care,
    dare as dare,
    filter_care as filter_care,
    filter_dare as filter_dare,
)
from ._finite_horizon import (
    cre as cre,
    dre as dre,
    FiniteHorizonSolution as FiniteHorizonSolution,
)
from ._hinfinity import hinf_care as hinf_care, hinf_dare as hinf_dare
from ._hinfinity_horizon import hinf_cre as hinf_cre, hinf_dre as hinf_dre
from ._level import GameSolution as GameSolution
from ._linear import (
    dlyap as dlyap,
    dsylvester as dsylvester,
    lyap as lyap,
    MatrixSolution as MatrixSolution,
    sylvester as sylvester,
)
from ._stabilising import RiccatiSolution as RiccatiSolution
