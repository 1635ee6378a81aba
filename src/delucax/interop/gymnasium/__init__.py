"""The tasks in Gymnasium's interface. Needs the extra `delucax[gymnasium]`.

Importing it tells Gymnasium of them: `gymnasium.make("delucax/Pendulum-v1")`.
"""

from ..._extras import extra


extra("gymnasium", "gymnasium")

from ._registration import (  # noqa: E402
    make as make,
    make_vector as make_vector,
    register_ids as register_ids,
)
from ._single_env import GymnasiumEnv as GymnasiumEnv  # noqa: E402
from ._vector_env import GymnasiumVectorEnv as GymnasiumVectorEnv  # noqa: E402


register_ids()
