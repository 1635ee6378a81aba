"""What results were made with."""

import subprocess

import pytest
from helpers import once

from delucax._provenance import provenance


pytestmark = once


@pytest.fixture
def repository(tmp_path):
    def git(*words):
        name = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=0"]
        subprocess.run(["git", *name, *words], cwd=tmp_path, check=True)

    git("init", "-q")
    (tmp_path / "sweep.py").write_text("")
    git("add", ".")
    git("commit", "-q", "-m", "a")
    return tmp_path


def dirty(folder):
    found = provenance(folder)
    assert len(found["commit"]) == 40
    return found["dirty"]


def test_code_that_the_commit_lacks_is_a_change(repository):
    (repository / "results").mkdir()
    (repository / "results" / "sweep.jsonl").write_text("")
    assert not dirty(repository / "results")  # its own output is none
    new = repository / "deep er" / "helper.py"
    new.parent.mkdir()
    new.write_text("")
    assert dirty(repository)
    assert dirty(repository / "results")  # of the whole repository
    new.unlink()
    (repository / "sweep.py").write_text("x = 1")
    assert dirty(repository)


def test_outside_a_repository_there_is_no_commit(tmp_path):
    found = provenance(tmp_path)
    assert found["commit"] is None and found["dirty"] is None
