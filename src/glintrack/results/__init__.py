"""Results of a flight: collect them, write them, read them."""

from typing import TYPE_CHECKING

from glintrack.core.lazy import lazy_names

if TYPE_CHECKING:
    from glintrack.results.write import write_result

__all__ = ["write_result"]
__getattr__, __dir__ = lazy_names(__name__, __file__)
