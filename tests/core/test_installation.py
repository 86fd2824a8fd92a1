"""A missing extra is named with a line that installs it, wherever this installation came from."""

import json
import shlex
import sys

import pytest

from glintrack.core import installation as extras
from glintrack.core.installation import MissingExtraError, install_line, package_version, require_extra


def test_a_module_that_is_there_is_imported():
    assert require_extra("json", "video", "write JSON") is json


def test_the_version_of_a_package_that_is_missing_is_said():
    assert package_version("numpy").count(".") >= 2
    assert package_version("no-such-package") == "not installed"


def test_a_missing_module_is_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "stonesoup.types", None)
    with pytest.raises(MissingExtraError) as caught:
        require_extra("stonesoup.types", "stonesoup", "pass tracks on")
    sentence = "the extra `stonesoup` must be installed to pass tracks on; got no package stonesoup. Run: "
    assert str(caught.value).startswith(sentence)
    assert isinstance(caught.value, ValueError)


@pytest.fixture
def installed(monkeypatch, tmp_path):
    """Pretend that the program was installed from what PEP 610 says, not run from its clone."""

    def pretend(about):
        class Distribution:
            def read_text(self, name):
                assert name == "direct_url.json"
                return json.dumps(about) if about else None

        monkeypatch.setattr(extras, "__file__", str(tmp_path / "lib" / "site" / "glintrack" / "extras.py"))
        monkeypatch.setattr(extras.metadata, "distribution", lambda name: Distribution())
        return shlex.split(install_line("em"))[1:]  # without the interpreter

    return pretend


def clone(folder):
    folder.mkdir()
    for name in ("pyproject.toml", "constraints.txt"):
        (folder / name).write_text("")
    return folder


def test_from_a_clone_the_clone_is_installed_again(installed, tmp_path):
    folder = clone(tmp_path / "my clone")
    pinned = ["-m", "pip", "install", "-c", str(folder / "constraints.txt")]
    assert installed({"url": folder.as_uri(), "dir_info": {}}) == [*pinned, f"{folder}[em]"]
    editable = {"url": folder.as_uri(), "dir_info": {"editable": True}}
    assert installed(editable) == [*pinned, "-e", f"{folder}[em]"]


def test_from_elsewhere_its_address_is_given(installed, tmp_path):
    pip = ["-m", "pip", "install"]
    assert installed(None) == [*pip, "glintrack[em]"]
    wheel = "https://example.org/glintrack-0.1.0-py3-none-any.whl"
    assert installed({"url": wheel, "archive_info": {}}) == [*pip, f"glintrack[em] @ {wheel}"]
    source = {"url": "https://example.org/glintrack.git", "vcs_info": {"vcs": "git", "commit_id": "abc"}}
    assert installed(source) == [*pip, f"glintrack[em] @ git+{source['url']}@abc"]
    gone = (tmp_path / "deleted").as_uri()
    assert installed({"url": gone, "dir_info": {}}) == [*pip, f"glintrack[em] @ {gone}"]


def test_this_checkout_installs_itself():
    words = shlex.split(install_line("em"))
    assert words[:4] == [sys.executable, "-m", "pip", "install"]
    assert words[-1].endswith("[em]")
