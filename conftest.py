"""Which tests may skip where everything is installed: ``pytest --no-unexpected-skip``, as CI runs them.

A test skips where a package, a program or a right is missing. CI installs every package, so a skip for one
means that a test is dead; only what a machine may lack for good reasons is allowed.
"""

import re
from pathlib import Path

ALLOWED = (
    r"^mitsuba .*LLVM",  # the system's library: Debian 12 has none that is new enough
    r"^needs .*chromium",  # the system's browser
    r"^needs the right to mount",  # not root, or in a container without it
    r"^only on ",  # another platform
)


SLOW = Path(__file__).parent / "tests" / "slow.txt"


def pytest_collection_modifyitems(items):
    """Mark the tests of the list as slow: ``pytest -m "not slow"`` is the quick tier."""
    listed = set(SLOW.read_text(encoding="utf-8").splitlines()) if SLOW.is_file() else set()
    for item in items:
        if item.nodeid.split("[")[0] in listed:
            item.add_marker("slow")


def pytest_addoption(parser):
    """Add the option."""
    parser.addoption("--no-unexpected-skip", action="store_true", help="fail on a skip without good reason")


def unexpected_skips(reports):
    """(test, reason) of every skip that no allowed reason explains."""
    reasons = [(r.nodeid, str(r.longrepr[2]).removeprefix("Skipped: ")) for r in reports]
    return [(test, reason) for test, reason in reasons if not any(re.search(a, reason) for a in ALLOWED)]


def pytest_terminal_summary(terminalreporter, config):
    """Name the skips that fail the run."""
    if config.getoption("--no-unexpected-skip"):
        for test, reason in unexpected_skips(terminalreporter.stats.get("skipped", [])):
            terminalreporter.write_line(f"UNEXPECTED SKIP {test}: {reason}")


def pytest_sessionfinish(session, exitstatus):
    """Fail a run that passed but for them."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is None or hasattr(session.config, "workerinput"):  # a worker of pytest-xdist
        return
    asked = session.config.getoption("--no-unexpected-skip")
    if asked and exitstatus == 0 and unexpected_skips(reporter.stats.get("skipped", [])):
        session.exitstatus = 1
