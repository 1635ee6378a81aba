"""The learned lung and the deep controller that were published with Deluca."""

import os
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._check import as_path, check_finite
from .._controller import AbstractController
from .._jax import host_unless_traced, xp
from .._module import as_module, check_parameters, parameter, positive, weight
from .._results import Result, RESULTS
from .._typing import Observation, PRNGKey, RealScalar, Scalar, State, Time
from ..dynamics import AbstractDynamics
from ..math import clip
from ._waveform import BreathWaveform, check_waveform


STEPS = 5
"""The number of first steps of an inspiration, and of controls and of pressures in the
state."""
WIDTH = 100
ERRORS = 10
DT = 0.03
START = -1.51449
"""The scaled pressure before an inspiration, which the file does not hold. With this
number, the three errors in the authors' notebook are reproduced to six digits."""
_WHERE = "read_published"


class PublishedLung(AbstractDynamics):
    r"""The learned lung that was published with Deluca.

    At step $k$ of an inspiration, the scaled pressure is predicted as

    $$p_{k + 1} = \begin{cases}
    o_k^\top \tanh(H_k z_\mathrm{all}) + b_k & k < 5 \\
    \mathrm{network}(z) & k \ge 5
    \end{cases}$$

    from the inputs

    $$\begin{aligned}
    z_\mathrm{all} &= (u_k, \dots, u_{k - 4}, p_k, \dots, p_{k - 4}) \\
    z &= (u_k, \dots, u_{k - 4}, p_k, p_{k - 1}, p_{k - 2})
    \end{aligned}$$

    Here $u$ are the scaled controls. The published network has three layers with the
    SELU activation and without biases. At the start of an inspiration, all past
    controls and pressures are set to zero, except for the start pressure. While `u_out`
    is above 1/2, the state is reset to the state before an inspiration. This model does
    not clip the controls, but the task `lung/learned_lung` does.

    The model uses the published weights, but not the program of the authors. Under the
    conditions of the authors' notebook, the model has the same errors as in the
    notebook; see [the comparison](../../ventilator.md#the-published-simulator).

    The state holds the last controls and the last pressures, both scaled and with the
    newest first, and the number of steps since the start of the inspiration. The
    observation is the pressure [cmH2O].

    **Arguments:**

    - `hidden`, `output`, `bias`: $H$, $o$ and $b$, the weights for the first five
        steps, of shapes `(5, width, 10)`, `(5, width)` and `(5,)`.
    - `network`: a module that maps the 8 numbers of $z$ to a number.
    - `u_mean`, `u_std`, `p_mean`, `p_std`: the means and standard deviations that scale
        the controls [%] and the pressures [cmH2O].
    - `start`: the pressure before an inspiration [cmH2O].
    - `dt`: the control interval [s], 0.03 by default.

    **Raises:** `ValueError` if a scale or `dt` is not positive, a number is not finite,
    or a shape is wrong.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021 (deluca-lung).

    !!! example

        ```python
        import equinox as eqx
        import jax
        import jax.numpy as jnp
        from delucax import lung

        network = eqx.nn.MLP(8, "scalar", 4, 1, jax.nn.selu, key=jax.random.key(0))
        first = jnp.zeros((5, 4, 10)), jnp.zeros((5, 4)), jnp.zeros(5)
        scales = dict(u_mean=11.0, u_std=16.0, p_mean=21.0, p_std=10.0)
        model = lung.PublishedLung(*first, network, **scales, start=6.0)
        env = lung.learned_lung(model)
        ```
    """

    hidden: Float[Array, "5 width 10"] = weight()
    output: Float[Array, "5 width"] = weight()
    bias: Float[Array, " 5"] = weight()
    network: Any = weight()
    u_mean: Array = parameter()
    u_std: Array = parameter(constraint=positive)
    p_mean: Array = parameter()
    p_std: Array = parameter(constraint=positive)
    start: Array = parameter()
    dt: Array = parameter(DT, constraint=positive)

    control_names = ("u_in", "u_out")
    state_names = (
        *(f"u_in[-{i + 1}]" for i in range(STEPS)),
        "pressure",
        *(f"pressure[-{i}]" for i in range(1, STEPS)),
        "step",
    )

    def __check_init__(self):
        check_parameters(self)
        first = dict(output=(STEPS, None), bias=(STEPS,))
        _check_shapes(self, hidden=(STEPS, None, 2 * STEPS), **first)

    @host_unless_traced
    def resting(self) -> State:
        """The state before an inspiration."""
        first = (self.start - self.p_mean) / self.p_std
        return xp.concatenate([xp.zeros(STEPS), first[None], xp.zeros(STEPS)])

    def pressure(self, x: State) -> Scalar:
        """The pressure now.

        **Arguments:** `x`: the state.

        **Returns:** a scalar [cmH2O].
        """
        return self.p_mean + self.p_std * x[STEPS]

    def observe(self, t: Time, x: State) -> Observation:
        return jnp.reshape(self.pressure(x), (1,)).astype(x.dtype)

    def advance(
        self, t: RealScalar, x: Array, u: Array, w: Array | None
    ) -> tuple[Array, Result]:
        x = x if w is None else x + w
        control = jnp.reshape((u[0] - self.u_mean) / self.u_std, (1,)).astype(x.dtype)
        controls = jnp.concatenate([control, x[: STEPS - 1]])
        pressures, step = x[STEPS : 2 * STEPS], x[2 * STEPS]
        # Both predictions are computed, because a branch costs no less under vmap.
        i = jnp.clip(jnp.round(step), 0, STEPS - 1).astype(int)
        hidden = jnp.tanh(self.hidden[i] @ jnp.concatenate([controls, pressures]))
        early = self.output[i] @ hidden + self.bias[i]
        late = self.network(jnp.concatenate([controls, pressures[:3]]))
        predicted = jnp.where(step < STEPS - 0.5, early, late)
        after = jnp.hstack([controls, predicted, pressures[:-1], step + 1])
        after = jnp.where(u[1] > 0.5, self.resting(), after)
        return after.astype(x.dtype), RESULTS.successful


class PublishedController(AbstractController):
    r"""The deep controller of the inspiratory valve that was published with Deluca.

    $$u = \mathrm{clip}(o^\top \mathrm{relu}(W F e + c) + b, 0, \mathrm{high})$$

    Here $e$ is the vector of the last ten errors [cmH2O], newest first. Errors from
    before the breath are set to zero. With the published $F$, the entries of $F e$ are
    the means of the last 10 errors, of the last 9 errors, and so on, down to the last
    error alone. The published convolution has a kernel of 5 rows but an input with a
    single position, so only the middle row of the kernel has an effect.

    The controller uses the published weights, but not the program of the authors, like
    [`delucax.lung.PublishedLung`][]. [`delucax.lung.Breathing`][] resets this
    controller before each breath, unlike the original controller, which was not reset.
    The gradient of the control is zero where the control is clipped.

    **Arguments:**

    - `featurizer`: $F$, shape `(10, 10)`.
    - `convolution`, `biases`: the weights $W$ and $c$, of shapes `(width, 10)` and
        `(width,)`.
    - `output`, `bias`: the weights $o$, of shape `(width,)`, and $b$, a number.
    - `waveform`: the target, a [`delucax.lung.BreathWaveform`][].
    - `high`: the largest control [%], 40 by default, as published.

    **Raises:** `ValueError` if a number is not finite, a shape is wrong, or `waveform`
    is not a `BreathWaveform`.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021 (deluca-lung).

    !!! example

        ```python
        import jax.numpy as jnp
        from delucax import lung

        means = jnp.tril(jnp.ones((10, 10))) / jnp.arange(1, 11)[:, None]
        weights = jnp.ones((4, 10)), jnp.zeros(4), jnp.ones(4), 0.0
        waveform = lung.BreathWaveform()
        controller = lung.PublishedController(means, *weights, waveform)
        controller(0.0, jnp.array([34.0]), controller.init())[0]
        ```

        ```text
        Array([11.716], dtype=float32)
        ```
    """

    featurizer: Float[Array, "10 10"] = parameter()
    convolution: Float[Array, "width 10"] = weight()
    biases: Float[Array, " width"] = weight()
    output: Float[Array, " width"] = weight()
    bias: Array = weight()
    waveform: BreathWaveform
    high: Array = parameter(40.0, constraint=positive)

    def __check_init__(self):
        check_parameters(self)
        _check_shapes(self, featurizer=(ERRORS, ERRORS), convolution=(None, ERRORS))
        check_waveform(self.waveform, "PublishedController")

    def init(self, *, key: PRNGKey | None = None) -> PyTree:
        return jnp.zeros(ERRORS, self.convolution.dtype)

    def __call__(self, t: RealScalar, y: Array, state: PyTree) -> tuple[Array, PyTree]:
        error = (self.waveform(t) - y).astype(state.dtype)
        errors = jnp.concatenate([error, state[:-1]])
        hidden = self.convolution @ (self.featurizer @ errors) + self.biases
        u = self.output @ jnp.maximum(0, hidden) + self.bias
        u = clip(jnp.reshape(u, (1,)), 0, self.high)
        return u.astype(y.dtype), errors


class Published(NamedTuple):
    """The result of [`delucax.lung.read_published`][].

    **Attributes:** `lung`, a [`delucax.lung.PublishedLung`][]; `controller`, a
    [`delucax.lung.PublishedController`][].

    !!! example

        ```python
        from delucax import lung

        lung.Published._fields
        ```

        ```text
        ('lung', 'controller')
        ```
    """

    lung: PublishedLung
    controller: PublishedController


def read_published(
    path: str | os.PathLike, waveform: BreathWaveform | None = None
) -> Published:
    """Read the learned lung and the deep controller from a file of published weights.

    The file is a NumPy `.npz` file with the arrays of the two pickle files in the
    repository deluca-lung. The names and shapes of these arrays are

    - `sim/params/0/shallow_fc1_model1/kernel` (10, 100), and `kernel` (100, 1) and
        `bias` (1,) of `shallow_fc2_model1`, for the first step. The next four steps
        have arrays with the same shapes, up to
        `sim/params/4/shallow_fc1_model5/kernel`.
    - `sim/params/5/SNN_fc0/kernel` (10, 100), `SNN_fc1` and `SNN_fc2` (100, 100), and
        `kernel` (100, 1) and `bias` (1,) of `SNN_fc3`. The first two inputs of
        `SNN_fc0` are always zero.
    - `sim/u_scaler/mean` and `std`, `sim/p_scaler/mean` and `std`: numbers.
    - `deep_controller/featurizer` (10, 10); `kernel` (5, 10, 100) and `bias` (100,) of
        `deep_controller/params/deep_conv`, and (100, 1) and (1,) of `deep_fc`.

    In these arrays the newest control, pressure and error come last. The pressure
    before an inspiration is not in the file. `read_published` sets this pressure to
    1.51449 standard deviations below the mean, which is 6.094 cmH2O for the mean and
    standard deviation of the authors.

    **Arguments:**

    - `path`: the file.
    - `waveform`: the target of the controller, a [`delucax.lung.BreathWaveform`][];
        `BreathWaveform()` by default.

    **Returns:** a [`delucax.lung.Published`][]: `(lung, controller)`.

    **Raises:** `ValueError` if the file is not an `.npz`, an array is missing or has
    another shape, or a number is not finite. The message of the error names the file
    and the array. `OSError` if the file cannot be read.

    Source: Suo, Agarwal, Xia, Chen, Ghai, Yu, Gradu, Singh, Zhang, Minasyan, LaChance,
    Zajdel, Schottdorf, Cohen and Hazan, 2021 (deluca-lung).

    !!! example

        ```python
        import tempfile
        from pathlib import Path
        import numpy as np
        from delucax import lung

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "arrays.npz"
            np.savez(path, A=np.eye(2))
            try:
                lung.read_published(path)
            except ValueError as error:
                print(error)  # it lacks the array 'sim/u_scaler/mean', ...
        ```
    """
    waveform = BreathWaveform() if waveform is None else waveform
    check_waveform(waveform, _WHERE)
    arrays = _arrays(as_path(path, "path", _WHERE))
    scales = {
        f"{letter}_{name}": arrays[f"sim/{letter}_scaler/{name}"]
        for letter in "up"
        for name in ("mean", "std")
    }
    first = [_newest_first(arrays[_first(k)]) for k in range(STEPS)]
    last = [arrays[_first(k, 2)][:, 0] for k in range(STEPS)]
    biases = [arrays[_first(k, 2, "bias")][0] for k in range(STEPS)]
    lung = PublishedLung(
        jnp.asarray(np.stack(first)),
        jnp.asarray(np.stack(last)),
        jnp.asarray(np.stack(biases)),
        _network(arrays),
        **scales,
        start=scales["p_mean"] + START * scales["p_std"],
    )
    part = "deep_controller/params/"
    controller = PublishedController(
        # In the file, its rows are the errors, newest last, and its columns features.
        jnp.asarray(arrays["deep_controller/featurizer"][::-1].T),
        jnp.asarray(arrays[f"{part}deep_conv/kernel"][2].T),
        jnp.asarray(arrays[f"{part}deep_conv/bias"]),
        jnp.asarray(arrays[f"{part}deep_fc/kernel"][:, 0]),
        arrays[f"{part}deep_fc/bias"][0],
        waveform,
    )
    return Published(lung, controller)


def _first(k: int, layer: int = 1, name: str = "kernel") -> str:
    """The name of an array of the network of the first step `k`."""
    return f"sim/params/{k}/shallow_fc{layer}_model{k + 1}/{name}"


def _shapes() -> dict[str, tuple[int, ...]]:
    """The names and shapes of the arrays that a file must hold."""
    shapes: dict[str, tuple[int, ...]] = {
        f"sim/{letter}_scaler/{name}": () for letter in "up" for name in ("mean", "std")
    }
    for k in range(STEPS):
        shapes[_first(k)] = 2 * STEPS, WIDTH
        shapes |= {_first(k, 2): (WIDTH, 1), _first(k, 2, "bias"): (1,)}
    part = "sim/params/5/SNN_fc"
    shapes[f"{part}0/kernel"] = 2 * STEPS, WIDTH
    shapes |= {f"{part}{k}/kernel": (WIDTH, WIDTH) for k in (1, 2)}
    shapes |= {f"{part}3/kernel": (WIDTH, 1), f"{part}3/bias": (1,)}
    part = "deep_controller/params/deep_"
    shapes["deep_controller/featurizer"] = ERRORS, ERRORS
    shapes |= {f"{part}conv/kernel": (5, ERRORS, WIDTH), f"{part}conv/bias": (WIDTH,)}
    return shapes | {f"{part}fc/kernel": (WIDTH, 1), f"{part}fc/bias": (1,)}


def _arrays(path: Path) -> dict[str, Any]:
    """Check the arrays of a file. Returns them by name, in the precision of JAX."""
    if not path.is_file():
        raise FileNotFoundError(f"{_WHERE}: path must be a file, got '{path}'.")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{_WHERE}: '{path}' must be an .npz file of NumPy.")
    dtype, arrays = jnp.result_type(float), {}
    with np.load(path, allow_pickle=False) as held:
        for name, shape in _shapes().items():
            expected = f"the array '{name}' of shape {shape}"
            if name not in held:
                raise ValueError(f"{_WHERE}: '{path}' lacks {expected}.")
            array = held[name]
            if array.shape != shape or array.dtype.kind != "f":
                raise ValueError(
                    f"{_WHERE}: '{path}' must hold {expected}, of floats, got shape "
                    f"{array.shape} and {array.dtype}."
                )
            check_finite(array, f"'{name}' of '{path}'", _WHERE)
            arrays[name] = array.astype(dtype) if shape else float(array)
    return arrays


def _newest_first(kernel: np.ndarray) -> np.ndarray:
    """Weights of shape `(width, inputs)` for the controls and then the pressures,
    newest first. In the file the newest come last."""
    controls, pressures = kernel[:STEPS], kernel[STEPS:]
    return np.concatenate([controls[::-1], pressures[::-1]]).T


def _network(arrays: dict[str, Any]) -> eqx.nn.MLP:
    """The network of the later steps, without the two inputs that are always zero."""
    part = "sim/params/5/SNN_fc"
    kernels = [arrays[f"{part}{k}/kernel"].T for k in range(4)]
    kernels[0] = _newest_first(arrays[f"{part}0/kernel"][2:])
    options: Any = dict(use_bias=False, activation=as_module(jax.nn.selu))
    blank = eqx.filter_eval_shape(
        eqx.nn.MLP, 2 * STEPS - 2, "scalar", WIDTH, 3, **options, key=jax.random.key(0)
    )
    weights = lambda net: [*(layer.weight for layer in net.layers), net.layers[-1].bias]
    bias = arrays[f"{part}3/bias"]
    return eqx.tree_at(weights, blank, [*map(jnp.asarray, kernels), jnp.asarray(bias)])


def _check_shapes(module: Any, **shapes: tuple[int | None, ...]) -> None:
    """Raise an error unless the arrays have these shapes, where `None` is any size."""
    for name, shape in shapes.items():
        got = jnp.shape(getattr(module, name))
        fits = len(got) == len(shape) and all(
            size in (None, length) for size, length in zip(shape, got, strict=True)
        )
        if not fits:
            words = str(shape).replace("None", "width")
            raise ValueError(
                f"{type(module).__name__}: {name} must have the shape {words}, got "
                f"{got}."
            )
