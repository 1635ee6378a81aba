"""The tasks in Gymnasium's interface. Needs the extra `delucax[gymnasium]`.

Importing it tells Gymnasium of them: `gymnasium.make("delucax/Pendulum-v1")`.
"""

from ..._extras import extra as _extra


_extra("gymnasium", "gymnasium")

from ._registration import make as make, make_vector as make_vector  # noqa: E402
from ._single_env import GymnasiumEnv as GymnasiumEnv  # noqa: E402
from ._vector_env import GymnasiumVectorEnv as GymnasiumVectorEnv  # noqa: E402
