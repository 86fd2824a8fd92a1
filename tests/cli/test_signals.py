"""A signal ends the program with the code that a shell expects, whatever was torn by it."""

import signal
import subprocess
import sys

import pytest

PROGRAM = """
import os, signal, sys
from glintrack.cli import app as program

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # as does what nohup starts

def command():
    try:
        os.kill(os.getpid(), signal.{name})
        signal.pause()
    except KeyboardInterrupt:
        {then}

program._call = command
program.main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="only on POSIX systems are there these signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("then", ["return 0", "raise", "raise RuntimeError('torn')", "return 130"])
def test_exit_codes_tell_the_signal(name, then):
    text = PROGRAM.format(name=name, then=then)
    done = subprocess.run(
        [sys.executable, "-c", text], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 128 + getattr(signal, name), done.stderr
    assert done.stderr.startswith("glintrack: ") and "Traceback" not in done.stderr
