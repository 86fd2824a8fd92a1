"""What a default installation brings may be shipped with it: no licence that asks for one's own source."""

import tomllib

from tools.licences import PROJECT, faults, is_free, required_packages


def test_every_package_of_the_default_installation_may_be_shipped():
    found = required_packages(tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]["dependencies"])
    assert {"numpy", "numba", "llvmlite", "sasktran2"} <= set(found)  # what those need, too
    assert faults(found) == []


def test_what_asks_for_more_is_found():
    assert not is_free("GPL-3.0-only") and not is_free("not told") and not is_free("LGPL-2.1-only")
    assert not is_free("GNU Affero General Public License v3 or later (AGPLv3+)")
    assert is_free("BSD-3-Clause") and is_free("Apache-2.0 WITH LLVM-exception")
