import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    assert_close,
    needs_x64,
    user_error,
)
from scipy.linalg import solve_continuous_are

import delucax as dlx
from delucax.systems import LinearSystem


pytestmark = needs_x64


an = dlx.analysis
s = control.tf("s")
# All of order four, so that they share what is compiled.
LOOPS = {
    "servo": 2 * (s + 3) * (s + 9) / (s * (s + 1) * (s + 4) * (s + 7)),
    "resonant": 25 * (s + 1) / (s * (s + 2) * (s**2 + 2 * s + 16)),
    "conditional": 10 * (s + 3) ** 2 * (s + 9) / (s**3 * (s + 10)),
    "unstable plant": 6
    * (s + 1)
    * (s + 3)
    * (s + 6)
    / ((s - 1) * (s + 4) * (s + 2) * (s + 7)),
}


def loop_of(transfer, dt=None):
    theirs = control.ss(transfer)
    if dt is None:
        return LinearSystem(theirs.A, theirs.B, theirs.C), theirs
    theirs = control.c2d(theirs, dt)
    return dlx.LinearDynamics(theirs.A, theirs.B, theirs.C, dt=dt), theirs


def first_margins(theirs):
    """python-control's margins: the least gain above 1, the largest below, the phase.

    It leaves out frequency zero, and finds crossings at infinity.
    """
    gains, phases, _, at, over, _ = control.stability_margins(theirs, returnall=True)
    finite = at < 1e4
    gains, at = gains[finite], at[finite]
    up, down = gains > 1, gains < 1
    least = lambda values, where: where[np.argmin(values)] if len(values) else np.nan
    return (
        np.min(gains[up], initial=np.inf),
        least(gains[up], at[up]),
        np.max(gains[down], initial=0),
        least(-gains[down], at[down]),
        np.min(np.abs(np.deg2rad(phases)), initial=np.inf),
        least(np.abs(phases), over),
    )


STEPS = {"servo": 0.2, "resonant": 0.2, "conditional": 0.05, "unstable plant": 0.1}


@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("sampled", [False, True])
def test_margins_are_controls(name, sampled):
    dt = STEPS[name] if sampled else None
    loop, theirs = loop_of(LOOPS[name], dt)
    found = an.margins(loop)
    assert found.result == dlx.RESULTS.successful and found.is_stable
    expected = first_margins(theirs)
    ours = (
        found.gain_margin,
        found.gain_margin_frequency,
        found.gain_reduction,
        found.gain_reduction_frequency,
        found.phase_margin,
        found.phase_margin_frequency,
    )
    if name == "unstable plant":
        # It needs feedback at frequency zero, where L is negative.
        gain = float(np.squeeze(theirs.dcgain()))
        expected = (*expected[:2], -1 / gain, 0.0, *expected[4:])
    if sampled:
        # At the other end the loop is real too, and may be negative.
        factor = -1 / np.real(theirs(-1.0))
        if 1 < factor < expected[0]:
            expected = (factor, np.pi / dt, *expected[2:])
    assert_close(ours, expected, rtol=1e-7, atol=1e-9)


@pytest.mark.filterwarnings("ignore:Setting the shape:DeprecationWarning")
@pytest.mark.parametrize("name", ["servo", "resonant", "conditional"])
def test_disk_margins_are_controls_on_a_fine_grid(name):
    loop, theirs = loop_of(LOOPS[name])
    found = an.margins(loop)
    disks = {0: found.disk, 1: found.disk_s, -1: found.disk_t}
    for skew, disk in disks.items():
        near = float(disk.frequency) * np.linspace(0.99, 1.01, 401)
        grid = np.concatenate([np.logspace(-2, 3, 2000), near])
        margin, gain, phase = control.disk_margins(theirs, np.sort(grid), skew=skew)
        close = 1e-7
        assert_close(disk.margin, margin, rtol=close)
        assert_close(np.rad2deg(disk.phase), phase, rtol=close)
        # It gives the lesser of the two gains, in decibels.
        ours = np.minimum(disk.gain_high, 1 / disk.gain_low)
        assert_close(20 * np.log10(ours), gain, rtol=close)


def test_each_margin_puts_a_pole_on_the_boundary():
    loop, _ = loop_of(LOOPS["resonant"])
    found = an.margins(loop)
    A, B, C = (np.asarray(M, np.float64) for M in (loop.A, loop.B, loop.C))
    close = 1e-9
    # The closed loop with the gain raised.
    poles = np.linalg.eigvals(A - float(found.gain_margin) * B @ C)
    worst = poles[np.argmax(poles.real)]
    assert_close(worst.real, 0, atol=close)
    assert_close(abs(worst.imag), found.gain_margin_frequency, rtol=close)

    def L(omega):
        resolvent = 1j * omega * np.eye(len(A)) - A
        return (C @ np.linalg.solve(resolvent, B.astype(complex)))[0, 0]

    # The loop delayed, and turned.
    omega = float(found.delay_margin_frequency)
    delayed = L(omega) * np.exp(-1j * omega * float(found.delay_margin))
    assert_close([delayed.real, delayed.imag], [-1, 0], atol=close)
    turned = L(float(found.phase_margin_frequency))
    turned = turned * np.exp(-1j * float(found.phase_margin))
    assert_close([turned.real, turned.imag], [-1, 0], atol=close)
    # The worst perturbation of the disk: |S - 1/2| = 1 / alpha there.
    S = 1 / (1 + L(float(found.disk.frequency)))
    assert_close(abs(S - 0.5), 1 / found.disk.margin, rtol=close)


def test_first_order_lags_have_no_end_to_their_margins():
    # Four of them beside each other, of gain 1 together.
    poles = np.arange(-4.0, 0.0)
    lags = LinearSystem(np.diag(poles), np.ones((4, 1)), -poles[None] / 4)
    found = an.margins(lags)
    assert found.is_stable and found.gain_reduction == 0
    infinite = [found.gain_margin, found.phase_margin, found.delay_margin]
    assert np.all(np.isinf(infinite))
    assert np.isnan(found.gain_margin_frequency)
    assert_close(found.disk.margin, 2, rtol=1e-6)
    assert_close(found.disk.phase, np.pi / 2, rtol=1e-6)
    assert np.isinf(found.disk.gain_high) and np.isinf(found.disk.frequency)


def test_an_lqr_loop_has_the_margins_that_it_must():
    """Kalman's inequality: |S| <= 1 in continuous time, so a disk of radius 1."""
    _, plant = loop_of(LOOPS["unstable plant"])
    A, B = plant.A, plant.B
    K = B.T @ solve_continuous_are(A, B, np.eye(4), np.eye(1))
    found = an.margins(LinearSystem(A, B, C=K))
    assert_close(found.disk_s.margin, 1, atol=1e-9)
    assert found.phase_margin >= np.pi / 3 and found.gain_reduction <= 0.5
    assert np.isinf(found.gain_margin)


def test_gradients_are_central_differences_beside_an_unstable_loop():
    def loop(theta):
        gain, stiffness, damping = theta
        A = jnp.array([[1, 0.3], [0, 1]]) - 0.3 * jnp.stack(
            [jnp.zeros(2), jnp.stack([stiffness, damping])]
        )
        C = gain * jnp.array([[1.0, 0.0]])
        return dlx.LinearDynamics(A, jnp.array([[0.0], [0.3]]), C, dt=0.3)

    def measures(theta):
        m = an.margins(loop(theta), throw=False)
        values = [
            m.gain_margin,
            m.phase_margin,
            m.disk.margin,
            m.gain_margin_frequency,
            m.phase_margin_frequency,
            m.delay_margin,
            m.disk.gain_high,
            m.disk.phase,
        ]
        return jnp.stack(values), (jnp.stack(values), m.is_stable)

    theta = np.array([1.5, 2.0, 1.3])
    steps = 1e-6 * np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))])
    thetas = np.concatenate([theta + steps, [[14, 2.0, 1.3]]])
    found = jax.jit(jax.vmap(jax.jacrev(measures, has_aux=True)))(thetas)
    slopes, (values, stable) = jax.tree.map(np.asarray, found)
    assert list(stable) == [True] * 7 + [False]
    assert np.all(np.isfinite(values[:7]))
    numeric = (values[:3] - values[3:6]).T / 2e-6
    assert_close(slopes[6], numeric, rtol=1e-6, atol=1e-7)
    # A double pole's gain margin, in closed form.
    assert_close(values[6, 0], (1.3 / 0.3 - 2) / 1.5, rtol=1e-9)
    # And what NumPy computes of concrete numbers.
    for lane in (6, 7):
        assert_close(measures(thetas[lane])[0], values[lane], rtol=1e-9)
    # An unstable loop has no margins, and harms no other.
    assert_close(values[7, :3], [1, 0, 0])
    assert np.all(np.isfinite(slopes[7]))


@pytest.mark.parametrize(
    ("A", "B", "C", "phase"),
    [
        # k / (s - 1), with a gain margin at zero: the phase margin is acos(1 / k).
        ([[1.0]], [[1.0]], lambda k: [[k]], np.arccos),
        # (k s + 2) / (s^2 + 1), with a pole at 1 and without a gain margin.
        ([[0.0, 1.0], [-1.0, 0.0]], [[0.0], [1.0]], lambda k: [[2.0, k]], None),
    ],
)
def test_gradients_beside_a_margin_at_zero_or_without_one(A, B, C, phase):
    def margin(k):
        loop = LinearSystem(jnp.array(A), jnp.array(B), C=jnp.array(C(k)))
        return an.margins(loop, throw=False).phase_margin

    if phase is not None:
        assert_close(margin(2.0), phase(1 / 2.0), rtol=1e-9)
    slope = (margin(2.0 + 1e-5) - margin(2.0 - 1e-5)) / 2e-5
    assert_close(jax.grad(margin)(2.0), slope, rtol=1e-6)


def test_disk_margins_of_several_channels():
    # A loop that is fragile only if both gains change at once (Seiler et al., 2020).
    A = jnp.array([[0.0, 10.0], [-10.0, 0.0]])
    C = jnp.array([[1.0, 10.0], [-10.0, 1.0]])
    spinning = LinearSystem(A, jnp.eye(2), C)
    all_at_once = an.disk_margin(spinning)
    alone = [an.disk_margin(spinning, channel=i) for i in (0, 1)]
    for one in alone:
        # With the other channel closed it is the loop 1/s: all margins are infinite.
        assert_close(one.margin, 2, rtol=1e-4)
    close = 1e-7
    omegas = jnp.linspace(0.005, 40, 4001)
    L = np.asarray(an.frequency_response(spinning, omegas))
    S = np.linalg.inv(np.eye(2) + L)
    sizes = np.linalg.norm(S - np.eye(2) / 2, 2, axis=(1, 2))
    at_zero = np.linalg.inv(np.eye(2) - np.asarray(C) @ np.linalg.inv(A))
    largest = max(np.max(sizes), np.linalg.norm(at_zero - np.eye(2) / 2, 2))
    assert_close(1 / all_at_once.margin, largest, rtol=1e-4)
    assert all_at_once.margin < 0.2
    # Two loops that do not meet are as good as the worse of them.
    apart = LinearSystem(-jnp.diag(jnp.array([1.0, 2.0])), jnp.eye(2), 3 * jnp.eye(2))
    both = an.disk_margin(apart, -1.0).margin
    each = [an.disk_margin(apart, -1.0, channel=i).margin for i in (0, 1)]
    assert_close(both, np.min(each), rtol=close)


def test_bad_loops_are_refused():
    two = LinearSystem(-jnp.eye(2), jnp.eye(2))
    with user_error(match="one control and one output, got 2 and 2"):
        an.margins(two)
    with user_error(match="as many outputs as controls, got 2 and 1"):
        an.disk_margin(LinearSystem(-jnp.eye(2), jnp.ones((2, 1))))
    with user_error(match="skew must be a number"):
        an.disk_margin(two, [0.0, 1.0])
    with user_error(match="channel must be at most 1"):
        an.disk_margin(two, channel=2)
    with user_error(match="margins: model must be a LinearSystem"):
        an.margins(dlx.systems.Pendulum())
