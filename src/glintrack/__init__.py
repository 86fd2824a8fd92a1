"""glintrack: will this imaging sensor keep track of the vehicles?

``run("quickstart")`` simulates a case into a result folder, ``simulate(Case.from_toml("case.toml"))`` in
memory; ``load_result("result-quickstart")`` reads the arrays of a folder. Every command has its function
here. The names in ``__init__.pyi`` are imported when they are first used (SPEC 1).
"""

import lazy_loader

from glintrack.core.installation import VERSION as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]
