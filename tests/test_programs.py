"""Compiled programs on disk: what is kept, where, and what is not worth a failure."""

import os
import subprocess
import sys
import zlib
from pathlib import Path

import pytest
from helpers import once

import delucax._programs as programs


pytestmark = once

# Not `import delucax`: what the module does takes JAX alone.
SCRIPT = """
import collections, runpy, sys, warnings
keep_programs = runpy.run_path(sys.argv[1])["keep_programs"]
import jax, numpy
counts = collections.Counter()
jax.monitoring.register_event_listener(lambda event, **_: counts.update([event]))
warnings.simplefilter("always")
folder = keep_programs(*sys.argv[2:])
for n in range(1, 5):
    assert numpy.all(numpy.asarray(jax.jit(lambda x: 2 * x)(numpy.ones(n))) == 2.0)
print(folder)
print(*(counts[f"/jax/compilation_cache/cache_{n}"] for n in ("hits", "misses")))
"""


# Without what the tests themselves are run with.
ENVIRONMENT = {k: v for k, v in os.environ.items() if "COMPILATION_CACHE" not in k}
ENVIRONMENT.pop("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", None)


def compile_four(*arguments, **variables):
    """What a process says that keeps its programs: the folder, `(found, written)`, and
    its complaints."""
    command = [sys.executable, "-c", SCRIPT, programs.__file__, *map(str, arguments)]
    done = subprocess.run(
        command, env=ENVIRONMENT | variables, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    folder, counts = done.stdout.splitlines()
    return folder, tuple(map(int, counts.split())), done.stderr


def test_a_second_process_compiles_nothing(tmp_path):
    folder = tmp_path / "programs"
    assert compile_four(folder) == (str(folder), (0, 4), "")
    assert compile_four(folder) == (str(folder), (4, 0), "")


def test_the_folder_is_among_the_users_caches(tmp_path):
    variables = {"XDG_CACHE_HOME": str(tmp_path), "LOCALAPPDATA": str(tmp_path)}
    folder, counts, said = compile_four(**variables)
    assert (Path(folder), counts, said) == (tmp_path / "delucax/programs", (0, 4), "")


def test_the_variable_of_jax_names_the_folder(tmp_path):
    folder, counts, said = compile_four(JAX_COMPILATION_CACHE_DIR=str(tmp_path))
    assert (Path(folder), counts, said) == (tmp_path, (0, 4), "")


def test_the_threshold_of_the_user_stays(tmp_path):
    folder, counts, _ = compile_four(
        tmp_path, JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="60"
    )
    assert counts == (0, 0) and not list(tmp_path.iterdir())


def test_it_can_be_switched_off(tmp_path):
    off = {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    assert compile_four(tmp_path, **off) == ("None", (0, 0), "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("where", ["the file", "below it"])
def test_a_file_where_the_folder_should_be_is_a_warning(tmp_path, where):
    file = tmp_path / "file"
    file.write_text("not a folder")
    folder, counts, said = compile_four(file if where == "the file" else file / "below")
    assert (folder, counts) == ("None", (0, 0))
    assert said.count("compiled programs are not kept on disk") == 1
    assert str(file) in said


@pytest.mark.skipif(sys.platform != "linux", reason="nobody may write to Linux's /sys")
def test_a_read_only_folder_is_a_warning():
    folder, counts, said = compile_four("/sys")
    assert (folder, counts) == ("None", (0, 0))
    assert said.count("compiled programs are not kept on disk") == 1


def test_a_damaged_program_is_a_warning(tmp_path):
    compile_four(tmp_path)
    empty, cut_off, zeros, strange = tmp_path.glob("*-cache")
    empty.write_bytes(b"")
    cut_off.write_bytes(cut_off.read_bytes()[:50])
    zeros.write_bytes(b"\0" * 1000)
    strange.write_bytes(zlib.compress(b"\0\0\0\1 no program"))
    (tmp_path / "garbage-cache").write_bytes(b"garbage")
    folder, counts, said = compile_four(tmp_path)
    assert (Path(folder), counts[0]) == (tmp_path, 0)
    assert said.count("Error reading persistent compilation cache entry") == 4


def test_what_was_not_used_for_longest_is_deleted(tmp_path):
    for age, name in enumerate("abcd"):
        path = tmp_path / f"{name}-cache"
        path.write_bytes(b"0" * 100)
        os.utime(path, (1e9 - age, 1e9 - age))
    (tmp_path / "notes.txt").write_bytes(b"0" * 1000)
    programs.prune(tmp_path, 400)
    assert len(list(tmp_path.iterdir())) == 5
    programs.prune(tmp_path, 399)
    kept = {path.name for path in tmp_path.iterdir()}
    assert kept == {"a-cache", "b-cache", "notes.txt"}


EXPERIMENT = """
import jax
from delucax.experiments import experiment

@experiment.seeds(2)
def noise(key):
    return jax.random.normal(key).mean()
"""


@pytest.mark.parametrize("how", ["--cache", "--no-cache", "a file"])
def test_the_command_line_keeps_programs(tmp_path, how):
    (tmp_path / "few.py").write_text(EXPERIMENT)
    folder = tmp_path / "programs"
    if how == "a file":
        folder.write_text("not a folder")
    options = {
        "--cache": ["--cache", str(folder), "--workers", "2"],  # by the workers, too
        "--no-cache": ["--no-cache"],
        "a file": ["--cache", str(folder)],
    }
    done = subprocess.run(
        [sys.executable, "-m", "delucax", "run", "few.py", *options[how]],
        cwd=tmp_path,
        env=ENVIRONMENT | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "other")},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert ("not kept on disk" in done.stderr) == (how == "a file")
    assert bool(list(tmp_path.glob("programs/*-cache"))) == (how == "--cache")
    assert not (tmp_path / "other").exists()
