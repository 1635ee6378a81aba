"""The tasks with Gymnasium's interface. Needs the extra `delucax[gymnasium]`.

The import registers the tasks, so that `gymnasium.make("delucax/Pendulum-v1")` works.
"""

from ..._extras import extra as _extra


_extra("gymnasium", "gymnasium")

from ._registration import make as make, make_vector as make_vector  # noqa: E402
from ._single_env import GymnasiumEnv as GymnasiumEnv  # noqa: E402
from ._vector_env import GymnasiumVectorEnv as GymnasiumVectorEnv  # noqa: E402
