"""End commands by a signal at random moments, and see whether anything half-written stays or is told wrong.

    python scripts/kill_runs.py [--count 200] [--seed 0] [--json FILE]

Reports, videos, studies, runs and solved wire grids, all small, get SIGINT, SIGTERM, SIGHUP or SIGKILL at a
moment drawn between their begin and a tenth more than the time that they take. A fault is another exit code
than the signal's (or 0, of one that was done before), a traceback, a file or folder under its own name that
is not whole, or, where the command is called again, another result than that of a call that nobody ended.
"""

import argparse
import collections
import hashlib
import json
import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from glintrack.results.read import read_result
from tests.fuzz.caller import Caller, Outcome
from tests.fuzz.calls import CALLS, Call, write_files

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)
TRIED = {  # and of 200 calls how many; a grid is solved anew each time
    "report @result": 45,
    "video @result": 45,
    "study run": 45,
    "run": 45,
    "device wiregrid @grid": 20,
}
SAME = (".csv", ".geojson", ".parquet", ".html", ".gif")  # of files that two calls write to the last byte


class Killing:
    """One command, ended again and again."""

    def __init__(self, caller: Caller, call: Call, scratch: Path):
        self.caller, self.call, self.scratch = caller, call, scratch
        self.inputs = scratch / "in"
        self.whole = scratch / "whole"
        self.counts: collections.Counter = collections.Counter()
        self.faults: list[str] = []
        for _ in range(2):  # the first one compiles
            shutil.rmtree(self.whole, ignore_errors=True)
            began = time.monotonic()
            came = self.type(self.whole)
            self.usual_s = time.monotonic() - began
            if came.code:
                raise SystemExit(f"{call.command}: {came.err}")

    def type(self, outputs: Path, stopped: tuple[int, float] | None = None) -> Outcome:
        """The call, writing into a folder."""
        outputs.mkdir(exist_ok=True)
        places = {"@": self.inputs, ">": outputs}
        words = [str(places[w[0]] / w[1:]) if w[0] in places else w for w in self.call.arguments]
        cache = None
        if self.call.command == "device wiregrid":
            cache = self.scratch / "cache"
            if stopped or not outputs.is_relative_to(self.scratch / "out"):  # called again, it goes on
                shutil.rmtree(cache, ignore_errors=True)
        return self.caller.call([*self.call.command.split(), *words], outputs, None, stopped, cache)

    def end(self, number: int, after_s: float, again: bool) -> None:
        """One call that is ended; then the same call to its end, if wanted."""
        outputs = self.scratch / "out"
        shutil.rmtree(outputs, ignore_errors=True)
        came = self.type(outputs, (number, after_s))
        name = f"{self.call.command} by {signal.Signals(number).name} after {after_s:.2f} s"
        self.counts["done before" if came.code == 0 else "ended"] += 1
        right = (0, -number, 128 + number, 70)  # negative or 70 before the program has begun to heed it
        if came.code not in right or "Traceback" in came.err:
            self.faults.append(f"{name}: exit {came.code}, {came.err[-300:]!r}")
        left = [p.name for p in outputs.iterdir() if "partial" in p.name]
        if left and number != signal.SIGKILL:
            self.faults.append(f"{name}: left {left}")
        self._check(name, outputs, came.code == 0)
        if again:
            self.counts["called again"] += 1
            if self.call.command != "study run":
                for kept in [p for p in outputs.iterdir() if not p.name.startswith(".")]:
                    shutil.rmtree(kept) if kept.is_dir() else kept.unlink()  # what was kept has its name
            after = self.type(outputs)
            if after.code:
                self.faults.append(f"{name}, called again: exit {after.code}, {after.err[-300:]!r}")
            self._check(f"{name}, called again", outputs, True)
            hidden = [p.name for p in outputs.iterdir() if "partial" in p.name and p.is_dir()]
            if hidden:
                self.faults.append(f"{name}, called again: {hidden} is still there")

    def _check(self, name: str, outputs: Path, to_its_end: bool) -> None:
        """Whether what has its name is whole, and, of a call to its end, as that of nobody's ending."""
        for word in self.call.writes:
            made, meant = outputs / word, self.whole / word
            if not to_its_end and self.call.command == "study run":
                continue
            if not made.exists():
                if to_its_end and meant.exists():
                    self.faults.append(f"{name}: {word} is missing")
            elif not to_its_end and self.call.command == "run":
                notes = [note for note in read_result(made).notes if "interrupted" not in note]
                if any("cannot" in note or "missing" in note for note in notes):
                    self.faults.append(f"{name}: {notes}")
            elif digest(made) != digest(meant):
                self.faults.append(f"{name}: {word} is another one")


def _line(call: Call) -> str:
    return f"{call.command} {' '.join(call.arguments)}"


def digest(path: Path) -> dict[str, str]:
    """Hashes of what must be the same in every call."""
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    return {
        str(p.relative_to(path)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in files
        if p.suffix in SAME
    }


def main() -> None:
    """End, and tell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200, help="of all commands together")
    parser.add_argument("--again", type=int, default=4, help="every which call is made again to its end")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write counts and faults to this file")
    asked = parser.parse_args()
    chance, found = random.Random(asked.seed), {}
    chosen = {next(c for c in CALLS if _line(c).startswith(name)): share for name, share in TRIED.items()}
    with tempfile.TemporaryDirectory(prefix="glintrack-kill-") as scratch, Caller() as caller:
        write_files(Path(scratch) / "in")
        for call, share in chosen.items():
            killing = Killing(caller, call, Path(scratch))
            for k in range(asked.count * share // 200):
                killing.end(
                    SIGNALS[k % len(SIGNALS)], chance.uniform(0, 1.1 * killing.usual_s), k % asked.again == 0
                )
            found[call.command] = {"counts": killing.counts, "faults": killing.faults}
            shutil.rmtree(killing.whole)
            print(f"{call.command} ({killing.usual_s:.1f} s): {dict(killing.counts)}", *killing.faults,
                  sep="\n  ", flush=True)  # fmt: skip
    if asked.json:
        asked.json.write_text(json.dumps(found, indent=1) + "\n")
    sys.exit(1 if any(one["faults"] for one in found.values()) else 0)


if __name__ == "__main__":
    main()
