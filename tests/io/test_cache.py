"""The cache of solved files: by content, verified, written whole."""

from glintrack.io import cache


def test_what_is_kept_is_found(tmp_path):
    stem = cache.content_stem("a design")
    path = cache.store(stem, ".json", tmp_path, b"42")
    assert cache.find(stem, ".json", tmp_path) == path and path.read_bytes() == b"42"
    assert cache.find(cache.content_stem("another"), ".json", tmp_path) is None
    assert [p.name for p in tmp_path.iterdir()] == [path.name]  # nothing staged is left


def test_a_damaged_file_is_removed(tmp_path):
    stem = cache.content_stem("a design")
    path = cache.store(stem, ".nc", tmp_path, b"whole")
    path.write_bytes(b"torn")
    assert cache.find(stem, ".nc", tmp_path) is None and not path.exists()


def test_the_folder_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.cache_folder("wiregrid") == tmp_path / "glintrack" / "wiregrid"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache.cache_folder("hits").parts[-2:] == ("glintrack", "hits")
