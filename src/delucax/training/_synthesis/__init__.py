"""`synthesise`: the search for a policy, without settings of the task."""

from ._attempt import Attempt as Attempt
from ._synthesise import Synthesis as Synthesis, synthesise as synthesise
