"""The ventilator study: controllers that are trained in learned lungs."""

from ._study import lung_study as lung_study
