"""numba's kernels as files: their cache, their signatures as text, and compiling them ahead of a flight."""
