"""List the licence of every package that glintrack needs, directly or not, and by which extra.

    python tools/licences.py [--check] [--extra NAME ...]

The licence is what the installed package's own metadata says: its SPDX expression, else its classifiers, else
the start of its licence field. ``--check`` refuses a package of the default installation whose licence is not
one of `FREE`, or is not stated.
"""

import argparse
import importlib.metadata as metadata
import re
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

from packaging.requirements import Requirement

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
FREE = (
    *("MIT", "MIT-0", "BSD", "Apache", "ISC", "PSF", "Python Software Foundation", "HPND", "Zlib", "0BSD"),
    *("MPL", "Mozilla Public", "Unlicense", "CC0", "matplotlib", "Historical Permission"),
)


def name_of(package: str) -> str:
    """Normalize a package's name as registries compare it."""
    return re.sub(r"[-_.]+", "-", package).lower()


def required_packages(requirements: list[str]) -> dict[str, str]:
    """Installed packages that some requirements bring, directly or not; their licences."""
    found: dict[str, str] = {}
    open_ends = [(r.name, frozenset(r.extras)) for r in map(Requirement, requirements) if holds(r, {""})]
    seen = set()
    while open_ends:
        package, wanted = open_ends.pop()
        if (name_of(package), wanted) in seen:
            continue
        seen.add((name_of(package), wanted))
        try:
            about = metadata.distribution(package)
        except metadata.PackageNotFoundError:
            found[name_of(package)] = "not installed here"
            continue
        found[name_of(package)] = licence(about)
        for line in about.requires or []:
            requirement = Requirement(line)
            if holds(requirement, wanted or {""}):
                open_ends.append((requirement.name, frozenset(requirement.extras)))
    found.pop("glintrack", None)
    return found


def holds(requirement: Requirement, extras: Iterable[str]) -> bool:
    """Return True if a requirement applies here, with some extras."""
    marker = requirement.marker
    return marker is None or any(marker.evaluate({"extra": extra}) for extra in extras)


def licence(about: metadata.Distribution) -> str:
    """Licence of a package, from its metadata."""
    metadata_of = about.metadata
    if expression := metadata_of.get("License-Expression"):
        return str(expression)
    classes = [c for c in metadata_of.get_all("Classifier") or [] if c.startswith("License ::")]
    classes = [c.rpartition(" :: ")[2] for c in classes if not c.endswith("OSI Approved")]
    if classes:
        return "; ".join(classes)
    text = str(metadata_of.get("License") or "").strip()
    if "Redistribution and use in source and binary forms" in text:
        return "BSD, by its text"
    return text.splitlines()[0][:60] if text else "not stated"


def is_free(text: str) -> bool:
    """Return True if a licence permits distribution without disclosing source code."""
    return any(word.lower() in text.lower() for word in FREE) and "AGPL" not in text


def faults(found: dict[str, str]) -> list[str]:
    """List packages of a default installation with a licence that requires more, or is not stated."""
    return [f"{name}: {text}" for name, text in sorted(found.items()) if not is_free(text)]


def main() -> None:
    """List, or check."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="refuse what the default must not need")
    parser.add_argument("--extra", action="append", help="only of these extras [default: all]")
    asked = parser.parse_args()
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    plain, extras = required_packages(project["dependencies"]), project["optional-dependencies"]
    if asked.check:
        bad = faults(plain)
        print(*bad, sep="\n")
        print(f"{len(plain)} packages by default, {len(bad)} with a licence that requires more")
        sys.exit(1 if bad else 0)
    print("default installation")
    for name, text in sorted(plain.items()):
        print(f"  {name:30s} {text}")
    for extra in asked.extra or extras:
        if all(Requirement(line).name == "glintrack" for line in extras[extra]):
            continue  # other extras together
        more = {n: t for n, t in required_packages(extras[extra]).items() if n not in plain}
        print(f"extra {extra}")
        for name, text in sorted(more.items()):
            print(f"  {name:30s} {text}")


if __name__ == "__main__":
    main()
