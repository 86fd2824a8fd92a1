"""Try every command with hostile files in the place of those it reads, strange names and strange numbers.

    python scripts/try_commands.py [--only WORD] [--skip COMMAND] [--what files|names|numbers] [--json FILE]

A call may end well (exit 0) or be refused (2) in one short sentence that says what must be, within 2 s of CPU
time more than the valid call or 5 s, and leave nothing behind when it is refused. All else is a fault. What
is accepted is listed, for one has to look whether it should be.
"""

import argparse
import collections
import json
import shutil
import sys
import tempfile
import typing
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from glintrack.cli.app import load_program
from tests.fuzz.caller import Caller, Outcome
from tests.fuzz.calls import CALLS, Call, write_files
from tests.fuzz.hostile import NUMBERS, STRANGE_NAMES, kinds_for
from tests.fuzz.judge import fault_of_call

MORE_CPU_S, ENOUGH_CPU_S, LONGER_CPU_S = 2.0, 5.0, 30.0

FLIES = ("empty", "half", "first line alone", "first two lines")  # as a case: all else is its default


def words_of(call: Call, inputs: Path, outputs: Path, instead: dict[str, str]) -> list[str]:
    """What is typed, some files replaced."""
    out = call.command.split()
    for word in call.arguments:
        if word[0] == "@":
            out.append(instead.get(word[1:], str(inputs / word[1:])))
        else:
            out.append(str(outputs / word[1:]) if word[0] == ">" else word)
    return out


def number_options(command: str) -> Iterator[tuple[str, int]]:
    """Options of a command that take numbers, and how many."""
    found = load_program()
    for word in command.split():
        found = found.commands[word]  # pyright: ignore
    hints = typing.get_type_hints(found.callback)
    for parameter in found.params:
        held = {hints[parameter.name], *_inner(hints[parameter.name])}
        if parameter.param_type_name == "option" and held & {int, float}:
            yield parameter.opts[-1], parameter.nargs


def _inner(annotation) -> Iterator[object]:
    for one in typing.get_args(annotation):
        yield one
        yield from _inner(one)


class Trial:
    """Tries calls and keeps what came."""

    def __init__(self, caller: Caller, scratch: Path):
        self.caller, self.scratch = caller, scratch
        self.inputs, self.usual_s = scratch / "in", {}
        write_files(self.inputs)
        self.counts: collections.Counter = collections.Counter()
        self.faults: list[str] = []
        self.tried: set[tuple[str, str]] = set()
        self.accepted: list[str] = []

    def go(self, call: Call, what: str, instead: dict[str, str] | None = None, more: tuple = ()) -> Outcome:
        """One call; ``what`` says what is wrong with it."""
        outputs = self.scratch / "out"
        shutil.rmtree(outputs, ignore_errors=True)
        outputs.mkdir()
        words = [*words_of(call, self.inputs, outputs, instead or {}), *more]
        came = self.caller.call(words, outputs)
        name = f"{call.command} {' '.join(call.arguments)}: {what}"
        fault = fault_of_call(came.code, came.out, came.err)
        more_s = LONGER_CPU_S if came.code == 0 else MORE_CPU_S
        slow_s = max(self.usual_s.get(call, LONGER_CPU_S) + more_s, ENOUGH_CPU_S)
        if not fault and came.code and any(outputs.iterdir()):
            fault = f"left {sorted(p.name for p in outputs.iterdir())}"
        if not fault and came.cpu_s > slow_s:
            fault = f"slow: {came.cpu_s:.1f} s"
        if fault:
            self.faults.append(f"{name}: {fault}")
            print(f"FAULT {self.faults[-1]}", flush=True)
        elif came.code == 0:
            self.accepted.append(name)
        self.counts["fault" if fault else "accepted" if came.code == 0 else "refused"] += 1
        return came

    def files(self, call: Call) -> None:
        """Every file of a call, replaced by each kind of another thing."""
        for name in dict.fromkeys(call.reads):
            if (call.command, name) in self.tried:
                continue
            self.tried.add((call.command, name))
            for kind, write in kinds_for(name).items():
                if name == "case.toml" and kind in FLIES and call.command != "case check":
                    continue
                place = self.scratch / "hostile"
                shutil.rmtree(place, ignore_errors=True)
                shutil.copytree(self.inputs, place)
                path = place / name
                if path.is_dir():
                    shutil.rmtree(path)
                path.unlink(missing_ok=True)
                write(path, self.inputs / name)
                self.go(call, f"{name} is {kind}", {other: str(place / other) for other in call.reads})

    def names(self, call: Call) -> None:
        """Every file of a call under a strange name, and every output."""
        for name in dict.fromkeys((*call.reads, *call.writes)):
            for strange in STRANGE_NAMES:
                suffix = Path(name).suffix
                path = self.scratch / "named" / (strange[: 255 - len(suffix)] + suffix)
                shutil.rmtree(path.parent, ignore_errors=True)
                path.parent.mkdir()
                if name in call.reads:
                    path.symlink_to(self.inputs / name)
                    self.go(call, f"{name} is called {strange!r}", {name: str(path)})
                else:
                    words = tuple(f">{path}" if w == f">{name}" else w for w in call.arguments)
                    self.go(Call(call.command, words), f"{name} is called {strange!r}")

    def numbers(self, call: Call) -> None:
        """Every option that takes numbers, given each strange one."""
        for option, count in number_options(call.command):
            for number in NUMBERS:
                self.go(call, f"{option} {number[:20]}", more=(option, *([number] * count)))


def main() -> None:
    """Try, and tell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="calls that contain this")
    parser.add_argument("--skip", action="append", default=[], help="a command that is left out; repeatable")
    parser.add_argument("--what", choices=("files", "names", "numbers"), help="one kind of trial")
    parser.add_argument("--json", type=Path, help="write counts, faults and what was accepted to this file")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="glintrack-try-") as scratch, Caller() as caller:
        trial = Trial(caller, Path(scratch))
        for call in CALLS:
            if asked.only not in f"{call.command} {' '.join(call.arguments)}" or call.command in asked.skip:
                continue
            if call.ends:  # twice: the first compiles
                trial.usual_s[call] = min(trial.go(call, "valid").cpu_s for _ in range(2))
            for what in ("files", "names", "numbers"):
                if asked.what in (None, what) and (call.ends or what == "files"):
                    getattr(trial, what)(call)
            print(f"{call.command}: {dict(trial.counts)}", flush=True)
    print("accepted:", *trial.accepted, sep="\n  ")
    print("faults:", *trial.faults, sep="\n  ")
    if asked.json:
        found = {"counts": trial.counts, "faults": trial.faults, "accepted": trial.accepted}
        asked.json.write_text(json.dumps(found, indent=1) + "\n")
    sys.exit(1 if trial.faults else 0)


if __name__ == "__main__":
    main()
