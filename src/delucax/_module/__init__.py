"""Modules: kinds of fields, paths to leaves, names, files and stacks."""

from ._fields import (
    AbstractConstraint as AbstractConstraint,
    as_float_array as as_float_array,
    as_module as as_module,
    bounded as bounded,
    check_function as check_function,
    check_parameters as check_parameters,
    function_field as function_field,
    marked_leaves as marked_leaves,
    parameter as parameter,
    parts_of as parts_of,
    path_string as path_string,
    positive as positive,
    StaticFunction as StaticFunction,
    weight as weight,
)
from ._names import indexed_names as indexed_names, names_of as names_of
from ._networks import mlp as mlp
from ._paths import (
    by_path as by_path,
    check_paths as check_paths,
    get_path as get_path,
    replace as replace,
    with_values as with_values,
)
from ._serialise import load as load, save as save
from ._shown import shown as shown
from ._stack import (
    count_of as count_of,
    stack as stack,
    taken as taken,
    unstack as unstack,
)
