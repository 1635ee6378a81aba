"""Programs in C, compiled as strictly as can be, and called on arrays of NumPy."""

import numpy as np

from delucax import export


STRICT = "-std=c99 -pedantic -Wall -Wextra -Werror -ffp-contract=off".split()


def load(folder, name):
    """The controller or function of this name."""
    return export.load(folder, name=name, flags=(*STRICT, "-O1"))


def exported(folder, functions, **options):
    """Functions of name to `(function, example)`, each as one that returns the flag and
    the results."""
    for name, (function, example) in functions.items():
        export.c(function, folder, name=name, example=example, **options)
    return {name: flagged(load(folder, name)) for name in functions}


def flagged(function):
    """The flag and the results of a loaded function."""
    about = function.description

    def call(*inputs):
        given = [
            np.asarray(value, a.dtype, order="C")
            for value, a in zip(inputs, about.inputs, strict=True)
        ]
        outs = [np.empty(a.shape, a.dtype) for a in about.outputs]
        return function.bind(*given, *outs)(), outs

    return call
