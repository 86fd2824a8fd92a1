"""Tests; run pytest from the repository's root. Imported before conftest.py and so before glintrack."""

from hypothesis import settings
from jaxtyping import install_import_hook

from tests.array_shapes import PLAIN_MODULES

install_import_hook([f"glintrack.{module}" for module in PLAIN_MODULES], "tests.array_shapes.check")
# Same examples every time; no deadline, since numba compiles at the first call.
settings.register_profile("glintrack", derandomize=True, deadline=None)
settings.load_profile("glintrack")
