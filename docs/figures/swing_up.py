"""The animation of the README: the same policy before, during and after training.

`python docs/figures/swing_up.py` trains Gym's pendulum by the gradient through its ODE
and writes `docs/assets/swing_up.gif`, in less than a minute.
"""

from pathlib import Path

import jax
import matplotlib


matplotlib.use("agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from PIL import Image  # noqa: E402

import delucax as dlx  # noqa: E402
from delucax.studies import train_swing_up


TARGET = Path(__file__).parents[1] / "assets" / "swing_up.gif"
STEPS = {"untrained": 0, "after 100 steps": 100, "after 800 steps": 800}
STARTS, SECONDS, EVERY = 14, 5.0, 2


def angles(env, policy):
    """The angles of a batch of runs from starts that training has not seen, in turn."""
    starts = jax.vmap(env.reset)(jax.random.split(jax.random.key(2**20), STARTS))
    key, horizon = jax.random.key(0), round(SECONDS / float(env.dt))
    run = lambda x0: dlx.rollout(env, policy, key=key, x0=x0, horizon=horizon)
    return np.asarray(jax.jit(jax.vmap(run))(starts).states[:, ::EVERY, 0])


def frame(panels, k):
    """One picture: each panel shows all its pendulums at once."""
    figure, axes = plt.subplots(1, len(panels), figsize=(7.2, 2.7), dpi=100)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=0.9, wspace=0.02)
    colors = plt.get_cmap("viridis")(np.linspace(0.05, 0.85, STARTS))
    for ax, (title, angle) in zip(axes, panels.items(), strict=True):
        ax.axhline(0, color="0.88", linewidth=1, zorder=0)
        for theta, color in zip(angle[:, k], colors, strict=True):
            x, y = np.sin(theta), np.cos(theta)
            ax.plot([0, x], [0, y], color=color, linewidth=2.5, alpha=0.55)
            ax.plot(x, y, "o", color=color, markersize=9, alpha=0.75)
        ax.plot(0, 0, "o", color="0.2", markersize=4)
        ax.set(xlim=(-1.45, 1.45), ylim=(-1.2, 1.2), aspect="equal")
        ax.set_title(title, fontsize=12)
        ax.axis("off")
    figure.canvas.draw()
    picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    plt.close(figure)
    return picture


def main():
    env = dlx.make("pendulum")
    panels = {}
    for title, steps in STEPS.items():
        if steps:
            policy = train_swing_up(env, key=jax.random.key(0), steps=steps).model
        else:
            key = jax.random.split(jax.random.key(0))[0]
            policy = dlx.controllers.mlp_policy(env, width=32, depth=1, key=key)
        panels[title] = angles(env, policy)
    count = next(iter(panels.values())).shape[1]
    # It rests on the last picture before it begins again.
    shown = [frame(panels, k) for k in range(count)]
    palette = shown[count // 2].quantize(40, dither=Image.Dither.NONE)
    colors = palette.getpalette()
    background = max(palette.getcolors())[1]
    colors[3 * background : 3 * background + 3] = [255, 255, 255]
    small = [
        picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in shown
    ]
    for picture in small:
        picture.putpalette(colors)
    durations = [50 * EVERY] * (count - 1) + [1500]
    small[0].save(
        TARGET,
        save_all=True,
        append_images=small[1:],
        duration=durations,
        loop=0,
        optimize=True,
    )
    print(f"{TARGET}: {TARGET.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
