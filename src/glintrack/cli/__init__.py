"""The command line: one file a command."""

import os

# before NumPy is loaded: waiting threads of its matrix products would take the cores of a simulation
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
