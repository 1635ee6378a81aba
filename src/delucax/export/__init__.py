"""Export of controllers, plants and functions to C, and loading of that C."""

from ._c import c as c
from ._load import load as load
from ._loaded import (
    LoadedController as LoadedController,
    LoadedFunction as LoadedFunction,
    Running as Running,
)
from ._report import Report as Report
