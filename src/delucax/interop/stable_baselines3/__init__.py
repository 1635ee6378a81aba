"""Environments as a vectorised environment of Stable-Baselines3. Needs the extra
`delucax[sb3]`."""

from ..._extras import extra as _extra


_extra("stable_baselines3", "sb3")

from ._vec_env import SB3VecEnv as SB3VecEnv  # noqa: E402
