"""The cache of solved files: by content, verified, written whole."""

import os

from glintrack.io import cache


def test_what_is_kept_is_found(tmp_path):
    stem = cache.content_stem("a design")
    path = cache.keep(stem, ".json", tmp_path, b"42")
    assert cache.find(stem, ".json", tmp_path) == path and path.read_bytes() == b"42"
    assert cache.find(cache.content_stem("another"), ".json", tmp_path) is None
    assert [p.name for p in tmp_path.iterdir()] == [path.name]  # nothing staged is left


def test_a_damaged_file_is_removed(tmp_path):
    stem = cache.content_stem("a design")
    path = cache.keep(stem, ".nc", tmp_path, b"whole")
    path.write_bytes(b"torn")
    assert cache.find(stem, ".nc", tmp_path) is None and not path.exists()


def test_the_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.cache_folder("wiregrid") == tmp_path / "glintrack" / "wiregrid"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache.cache_folder("hits").parts[-2:] == ("glintrack", "hits")


def test_the_oldest_files_go_first(tmp_path):
    paths = [cache.keep(cache.content_stem(name), ".probes", tmp_path, bytes(100)) for name in "abc"]
    for age, path in zip((30, 20, 10), paths, strict=True):
        os.utime(path, (1e9 - age, 1e9 - age))
    cache.trim(".probes", tmp_path, 250)
    assert [path.exists() for path in paths] == [False, True, True]
    cache.trim(".probes", tmp_path, 1)
    assert [path.exists() for path in paths] == [False, False, True]  # the newest stays
