"""Embree's shared library is found where each platform's wheel holds it."""

import pytest

from glintrack.render.rays.embree import _library_file


@pytest.mark.parametrize(
    "held",
    [
        "embreex.libs/libembree4-5d1b6f2c.so.4",
        "embreex.libs/embree4.dll",
        "embreex/.dylibs/libembree4.4.dylib",
    ],
)
def test_the_library_of_each_wheel_is_found(tmp_path, held):
    """Files as the wheels of embreex 4.4.0.post1 for Linux, Windows and macOS name them."""
    package = tmp_path / "embreex"
    package.mkdir()
    library = tmp_path / held
    library.parent.mkdir(exist_ok=True)
    for name in (library, library.with_name("tbb12.dll"), library.with_name("libtbb.12.11.dylib")):
        name.touch()
    assert _library_file(package) == library


def test_a_wheel_without_embree_is_told(tmp_path):
    (tmp_path / "embreex").mkdir()
    with pytest.raises(ValueError, match=r"`embreex` must carry libembree4 or embree4.dll, got none beside"):
        _library_file(tmp_path / "embreex")
