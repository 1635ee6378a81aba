"""The front door: the names of the package, and its command line."""

import subprocess
import sys
from importlib.metadata import version

import pytest
from helpers import once

import delucax as dlx
from delucax.__main__ import _CACHE, _COMMANDS, _parser, main


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
        ("reproduce", ["one or more of the names below", "(default: off)"]),
        ("lung", ["(default: 3, or 1 with --small)", "(default: 2)"]),
        ("list", ["a Python file with experiments", "(default: all of them)"]),
        ("run", ["(default: results/FILE.jsonl)", "(default: 1)"]),
        ("report", ["(default: no page)", "95% intervals (default: off)"]),
        ("bench", ["(default: pendulum, wall_clock and environments)"]),
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


def test_every_option_shows_its_default():
    for *_, options in _COMMANDS:
        for name, settings in (*options, *_CACHE):
            assert name[0] != "-" or "(default: " in settings["help"], name


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


def test_all_that_can_be_run_is_listed(capsys):
    assert main(["list"]) == 0
    out = set(capsys.readouterr().out.split())
    assert {"igpc", "ilc", "ilqr", "MPPI", "SQP"} <= out  # planners
    assert {"KalmanFilter", "MHE", "BangBang", "pendulum-shock", "scoreboard"} <= out
    assert not {"Plan", "AbstractPlanner", "AbstractController"} & out


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["nope"], "choose from"),
        (["demo", "--seeds", "two"], "--seeds: expected a whole number, got 'two'"),
        (["run"], "required: FILE"),
        (["lung", "--sensor-delay", "1.5"], "expected a whole number, got '1.5'"),
    ],
)
def test_wrong_arguments_are_named(arguments, words, capsys):
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code == 2
    assert words in capsys.readouterr().err


def test_missing_files_are_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["lung", "--data", "none.csv"]) == 2
    assert capsys.readouterr().err == "error: there is no file 'none.csv'.\n"
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["bench"]) == 2
    assert "checkout of the repository" in capsys.readouterr().err


def test_an_interrupt_shows_no_traceback(monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("delucax.studies.demo", interrupted)
    assert main(["demo"]) == 130
    assert capsys.readouterr().err == "\nInterrupted.\n"
    monkeypatch.setattr("delucax.studies.lung_study", interrupted)
    assert main(["lung"]) == 130
    assert "continues where it stopped" in capsys.readouterr().err
