"""No public name appears or goes unnoticed. ``python tests/docs/test_public_names.py`` lists them again."""

import importlib
import inspect
import re
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
LIST = DOCS / "reference" / "public_names.txt"


def public_names():
    """Names of the packages and modules of the API page, in order."""
    modules = re.findall(r"^   (glintrack[\w.]*)$", (DOCS / "reference" / "api.md").read_text(), re.MULTILINE)
    found = set()
    for name in modules:
        module = importlib.import_module(name)
        own = getattr(module, "__all__", None) or [
            key
            for key, value in vars(module).items()
            if not key.startswith("_") and inspect.getmodule(value) is module and not inspect.ismodule(value)
        ]
        found |= {f"{name}.{key}" for key in own}
    return sorted(found)


def test_the_list_of_public_names_is_complete():
    listed = set(LIST.read_text(encoding="utf-8").split())
    found = set(public_names())
    assert found - listed == set(), (
        f"new names: write the list again with python tests/docs/{Path(__file__).name}"
    )
    assert listed - found == set(), (
        "names that users may import went: deprecate them first (docs/reference/stability.md)"
    )


if __name__ == "__main__":
    LIST.write_text("\n".join(public_names()) + "\n", encoding="utf-8")
