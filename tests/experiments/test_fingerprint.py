"""What counts as a change of a case."""

import collections
import enum
import importlib
import os
import subprocess
import sys
import typing

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once

from delucax import experiments
from delucax.experiments import experiment
from delucax.experiments._fingerprint import fingerprint


pytestmark = once

BODIES = {
    "a plain class": """
class Policy:
    def __init__(self, gain):
        self.gain = gain
    def act(self):
        return 2 * self.gain
value = Policy(3)
""",
    "within another": """
class Gain:
    def read(self):
        return 2
class Policy:
    def __init__(self, gain):
        self.gain = gain
value = [Policy(Gain())]
""",
    "a function that it holds": """
def act():
    return 2
class Policy:
    pass
value = Policy()
value.act = act
""",
    "a function in a library's object": """
import types
value = types.SimpleNamespace(act=lambda: 2)
""",
    "a property": """
class Policy:
    @property
    def gain(self):
        return 2
value = Policy()
""",
    "slots": """
class Policy:
    __slots__ = ("gain",)
value = Policy()
value.gain = 2
""",
    "a named tuple": """
import typing
class Policy(typing.NamedTuple):
    gain: float
    def act(self):
        return 2 * self.gain
value = Policy(3.0)
""",
    "an enum": """
import enum
class Mode(enum.Enum):
    SLOW = 2
value = Mode.SLOW
""",
    "the method of an enum": """
import enum
class Mode(enum.Enum):
    SLOW = 1
    def factor(self):
        return 2
value = Mode.SLOW
""",
    "a kind of dictionary": """
class Gains(dict):
    def total(self):
        return 2
value = Gains(a=1)
""",
    "a kind of list": """
class Gains(list):
    def total(self):
        return 2
value = Gains([1, 3])
""",
    "a wrapper": """
class Twice:
    def __init__(self, f):
        self.__wrapped__ = f
    def __call__(self):
        return 2 * self.__wrapped__()
value = Twice(lambda: 3)
""",
    "a node of a tree": """
import jax
@jax.tree_util.register_pytree_node_class
class Node:
    def tree_flatten(self):
        return (1.0,), None
    @classmethod
    def tree_unflatten(cls, beside, leaves):
        return cls()
    def act(self):
        return 2
value = Node()
""",
    "what a method closes over": """
def make(gain):
    class Policy:
        def act(self):
            return gain
    return Policy()
value = make(2)
""",
    "a global without content": """
class Camera:
    def __init__(self):
        self.feed = iter(())
    def read(self):
        return 2
camera = Camera()
def value():
    return camera.read()
""",
}


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Makes a module of a text, as an import after an edit does."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def load(text):
        (tmp_path / "edited_case.py").write_text(text)
        sys.modules.pop("edited_case", None)
        import edited_case  # pyright: ignore[reportMissingImports]

        return edited_case.value

    yield load
    sys.modules.pop("edited_case", None)


@pytest.mark.parametrize("text", BODIES.values(), ids=BODIES)
def test_the_code_behind_a_value_counts(module, text):
    one, same = fingerprint(module(text)), fingerprint(module("# said\n" + text))
    assert one == same
    assert fingerprint(module(text.replace("2", "5"))) != one


@pytest.mark.parametrize("text", BODIES.values(), ids=BODIES)
def test_and_so_it_does_where_there_is_no_source(text):
    def typed(text):
        scope = {"__name__": "typed"}
        exec(text, scope)
        return fingerprint(scope["value"])

    assert typed(text) == typed(text) != typed(text.replace("2", "5"))


def test_a_method_that_changed_is_run_again(module, tmp_path):
    def results(text):
        @experiment.parametrize("policy", [module(text)])
        def cost(policy):
            return policy.act()

        found = experiments.run(cost, store=tmp_path / "results.jsonl", progress=False)
        return [row["value"] for row in found.rows]

    text = BODIES["a plain class"]
    assert results(text) == [6]
    assert results(text.replace("2 *", "5 *")) == [15]


def test_objects_in_a_ring_and_in_common_are_read_once():
    class Node:
        def __init__(self, *others):
            self.others = others

    def ladder(height):
        """Shared twice at each step: read each time, it would take 2 ** height."""
        node = Node()
        for _ in range(height):
            node = Node(node, node)
        return node

    ring, other = Node(), Node(1)
    ring.others, other.others = (ring, 1), (other, 2)
    assert fingerprint(ladder(60)) == fingerprint(ladder(60)) != fingerprint(ladder(61))
    assert fingerprint(ring) != fingerprint(other)


def test_a_function_that_was_read_before_still_counts(module):
    text = """
def adam():
    return 1
def sgd():
    return 2
use = adam
def value():
    return adam(), sgd(), use()
"""
    one = fingerprint(module(text))
    assert fingerprint(module(text.replace("use = adam", "use = sgd"))) != one


@pytest.mark.parametrize(
    "line, call",
    {
        "from near.far import f": "f()",
        "from near import far": "far.f()",
        "import near.far": "near.far.f()",
    }.items(),
)
@pytest.mark.parametrize("inside", [False, True])
def test_what_the_code_imports_counts(tmp_path, monkeypatch, line, call, inside):
    """At the top or within a function, also from a package without a file."""
    text = f"{line}\ndef value():\n    return {call}\n"
    if inside:
        text = (
            f"def value():\n    {line}\n    import no_such_module\n    return {call}\n"
        )
    found = []
    for k, number in enumerate((1, 1, 2)):
        folder = tmp_path / str(k)
        (folder / "near").mkdir(parents=True)
        (folder / "near" / "far.py").write_text(f"def f():\n    return {number}\n")
        (folder / "importer.py").write_text(text)
        with monkeypatch.context() as patch:
            patch.syspath_prepend(folder)
            value = importlib.import_module("importer").value
            found += [fingerprint(value), fingerprint(value)]
        for name in ("importer", "near", "near.far"):
            del sys.modules[name]
    assert len({*found[:4]}) == 1 and found[4] == found[5] != found[0]


class Pair(typing.NamedTuple):
    a: int


class Mode(enum.Enum):
    FAST = 1


def test_the_content_of_objects_counts():
    things = [
        *(Pair(1), Pair(2), (1,), Mode.FAST, collections.deque([1])),
        *(collections.deque([2]), np.random.default_rng(0), np.random.default_rng(1)),
        *(np.array([1, "a"], object), np.array([1, "b"], object)),
    ]
    assert len({fingerprint(thing) for thing in things}) == len(things)
    with pytest.raises(TypeError, match="cannot pickle"):
        fingerprint([jnp.ones(1), {"lock": __import__("threading").Lock()}])


OTHER = """
import jax, jax.numpy as jnp, optax, diffrax, datetime, re
import delucax as dlx
from delucax.experiments._fingerprint import fingerprint
class Policy:
    def __init__(self):
        self.names, self.gain = {"b", "a", "d", "c"}, jnp.ones(3)
odd = lambda x: x in {"a", "b", "c", "d"}
things = [
    {"b", "a", "d", "c"}, odd, optax.adam(0.1), jnp.sin, jnp.arange(3.0),
    jax.random.key(3), diffrax.Tsit5(), dlx.controllers.Linear(jnp.ones((1, 2))),
    [1, 1.0, True, None, "x", (1,), {"k": 2}], jax.jit(odd), dict, Policy(),
    datetime.date(2026, 1, 2), re.compile("a+"),
]
assert len({fingerprint(thing) for thing in things}) == len(things) - 1  # jit(odd)
print(*map(fingerprint, things))
value = None
"""


def test_the_hash_is_that_of_another_process(module, tmp_path, capsys):
    module(OTHER)
    there = subprocess.run(
        [sys.executable, "-c", "import edited_case"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONHASHSEED": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert capsys.readouterr().out == there.stdout
