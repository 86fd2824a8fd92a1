"""How many heaps glibc makes for threads, by its own account."""

import ctypes
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "malloc_info"), reason="not glibc"
)

COUNT = """
import ctypes, sys, threading
from glintrack.heaps import share_heaps
assert sys.argv[1] == "own" or share_heaps()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
start = threading.Barrier(8)
def take():
    start.wait()
    libc.malloc(1000)
    start.wait()
threads = [threading.Thread(target=take) for _ in range(8)]
[one.start() for one in threads]
[one.join() for one in threads]
libc.fopen.restype, libc.fopen.argtypes = ctypes.c_void_p, [ctypes.c_char_p, ctypes.c_char_p]
libc.malloc_info.argtypes, libc.fclose.argtypes = [ctypes.c_int, ctypes.c_void_p], [ctypes.c_void_p]
out = libc.fopen(b"/dev/stdout", b"w")
libc.malloc_info(0, out)
libc.fclose(out)
"""


def heaps(which):
    found = subprocess.run(
        [sys.executable, "-c", COUNT, which], capture_output=True, text=True, check=True, timeout=60
    )
    return found.stdout.count("<heap nr=")


def test_threads_share_two_heaps():
    assert heaps("shared") <= 2 < heaps("own")


def test_whoever_sets_the_variable_decides(monkeypatch):
    monkeypatch.setenv("MALLOC_ARENA_MAX", "5")
    code = "from glintrack.heaps import share_heaps; print(share_heaps())"
    assert subprocess.check_output([sys.executable, "-c", code], text=True, timeout=60) == "False\n"
