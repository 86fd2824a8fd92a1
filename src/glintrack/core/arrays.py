"""The one name for a NumPy array in jaxtyping's shapes: ``Float[Array, "y x stokes"]``."""

import numpy as np

Array = np.ndarray
