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
from glintrack.core.heaps import share_heaps
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
    code = "from glintrack.core.heaps import share_heaps; print(share_heaps())"
    assert subprocess.check_output([sys.executable, "-c", code], text=True, timeout=60) == "False\n"


KEPT = """
import ctypes
from glintrack.core.heaps import return_freed, share_heaps
share_heaps()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = (
    ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
)
def used_mb():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6
blocks = [libc.malloc(100_000) for _ in range(2000)]  # below what the system is asked for at once
for one in blocks:
    ctypes.memset(one, 1, 100_000)
for one in blocks[:-1]:
    libc.free(one)
kept = used_mb()
return_freed()
held = kept - used_mb()
return_freed(above_bytes=0)
print(held, kept - used_mb())
"""


def test_what_was_freed_goes_back_to_the_system():
    told = subprocess.check_output([sys.executable, "-c", KEPT], text=True, timeout=60)
    at_once, asked = map(float, told.split())
    assert abs(at_once) < 1  # so little is held that the next may have it
    assert asked > 150  # of 200 MB below a block in use
