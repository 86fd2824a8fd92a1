"""The folder of compiled kernels follows the sources, and only the command line names it."""

import os
import subprocess
import sys

import pytest

from glintrack.core import numba_cache


@pytest.fixture
def unset(monkeypatch):
    monkeypatch.delenv(numba_cache.VARIABLE, raising=False)
    yield
    os.environ.pop(numba_cache.VARIABLE, None)


def test_the_folder_is_named_by_the_sources(unset, monkeypatch, tmp_path):
    folder = numba_cache.set_cache_folder(tmp_path)
    assert os.environ["NUMBA_CACHE_DIR"] == str(folder)
    assert folder.parent == tmp_path and folder.name == numba_cache.sources_digest()


def test_other_sources_have_another_digest(monkeypatch, tmp_path):
    package = tmp_path / "glintrack"
    (package / "core").mkdir(parents=True)
    (package / "a.py").write_text("LIMIT = 1\n")
    monkeypatch.setattr(numba_cache, "__file__", str(package / "core" / "numba_cache.py"))
    first = numba_cache.sources_digest()
    assert numba_cache.sources_digest() == first
    (package / "a.py").write_text("LIMIT = 2\n")
    assert numba_cache.sources_digest() != first


def test_a_folder_of_the_user_is_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "own"))
    assert numba_cache.set_cache_folder(tmp_path / "ours") == tmp_path / "own"
    assert not (tmp_path / "ours").exists()


def test_old_folders_are_deleted(unset, tmp_path):
    for k in range(5):
        (tmp_path / str(k)).mkdir()
        os.utime(tmp_path / str(k), (k, k))
    numba_cache.set_cache_folder(tmp_path)
    kept = {path.name for path in tmp_path.iterdir()}
    assert kept == {"3", "4", numba_cache.sources_digest()}


def test_compiled_kernels_are_noted(unset, tmp_path):
    numba_cache.set_cache_folder(tmp_path)
    assert not numba_cache.is_complete()
    numba_cache.mark_complete()
    assert numba_cache.is_complete()


def test_the_library_sets_no_folder():
    code = "import os, glintrack.loop; assert 'NUMBA_CACHE_DIR' not in os.environ"
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
