"""Matrix equations of control, by solves and products alone."""

from ._dare import dare as dare, RiccatiSolution as RiccatiSolution
