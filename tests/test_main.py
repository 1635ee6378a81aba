"""The front door: the names of the package, and its command line."""

import subprocess
import sys
from importlib.metadata import version

import pytest
from helpers import once

import delucax as dlx
from delucax.__main__ import _parser, main


pytestmark = once


def test_version():
    assert dlx.__version__ == version("delucax")


def test_experiments_are_loaded_when_asked_for():
    code = """
        import sys, delucax
        assert "experiments" in dir(delucax)
        assert not {"pandas", "joblib", "delucax.experiments"} & set(sys.modules)
        assert delucax.experiments.run.__name__ == "run"
    """
    code = "\n".join(line.strip() for line in code.splitlines())
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_a_command_help_is_shown(capsys):
    assert main([]) == 0
    out = capsys.readouterr().out
    assert "usage: delucax" in out and "reproduce" in out


def test_version_of_the_command_line(capsys):
    with pytest.raises(SystemExit) as left:
        main(["--version"])
    assert left.value.code == 0
    assert capsys.readouterr().out == f"delucax {dlx.__version__}\n"


def test_how_it_was_called(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/somewhere/delucax/__main__.py"])
    assert _parser().prog == "python -m delucax"


@pytest.mark.parametrize(
    "command, shown",
    [
        ("demo", ["(default: demo)", "(default: 2)"]),
        ("lung", ["(default: 3, or 1 if --small)", "(default: 2)"]),
        ("list", ["a Python file of experiments", "(default: all)"]),
        ("run", ["(default: results/FILE.jsonl)", "(default: 1)"]),
        ("bench", ["(default: all)"]),
    ],
)
def test_help_shows_defaults(command, shown, capsys):
    with pytest.raises(SystemExit) as left:
        main([command, "--help"])
    out = " ".join(capsys.readouterr().out.split())
    assert left.value.code == 0
    for words in shown:
        assert words in out
    assert "False" not in out and "default: )" not in out


def test_every_controller_is_listed(capsys):
    assert main(["list"]) == 0
    out = set(capsys.readouterr().out.split())
    assert {"lqrd", "LQR", "mlp_policy"} <= out
    controllers = {
        name
        for name, member in vars(dlx.controllers).items()
        if isinstance(member, type)
        and issubclass(member, dlx.AbstractController)
        and not name.startswith("Abstract")
    }
    assert controllers <= out
