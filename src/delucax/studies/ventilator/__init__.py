"""Controllers of a ventilator, trained in learned lungs and tried on others."""

from ._study import lung_study as lung_study
