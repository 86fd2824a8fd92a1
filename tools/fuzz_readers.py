"""Feed every reader damaged files in child processes with bounds on time and memory, and count what comes.

    python tools/fuzz_readers.py [--count 10000] [--only NAME] [--but .nc] [--seed 0] [--keep FOLDER]
                                   [--every 500]

A reader may return a value that is finite, or refuse in one sentence. Anything else is a fault: another
exception, a message without a requirement, a number that is not finite, a crash, more than `CPU_S` or
`MEMORY_BYTES`. Its file is kept. Input k of a reader depends on the seed, the reader's name and k alone, so
that of a run that was stopped the counts told by then are those of a shorter one.
"""

import argparse
import collections
import json
import multiprocessing
import multiprocessing.connection
import os
import random
import resource
import sys
import tempfile
import time
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.fuzz.judge import judged
from tests.fuzz.mutations import mutated
from tests.fuzz.readers import READERS, Reader

CPU_S = 2.0
MEMORY_BYTES = 500_000_000
WALL_S = 60.0  # of a process that uses no CPU time
SEEDLING = "seed"


def damaged(reader: Reader, valid: bytes, seed: int, k: int) -> bytes:
    """Input k of a reader."""
    return mutated(valid, random.Random(f"{seed} {reader.name} {k}"))


def work(reader: Reader, folder: Path, seed: int, ks: range, pipes: tuple) -> None:
    """Read one damaged file after the other; tell of each how it went."""
    others, pipe = pipes
    others.close()  # so that this process ends with the other
    warnings.simplefilter("ignore")
    valid_path = folder / f"{SEEDLING}{reader.suffix}"
    reader.write(valid_path)
    valid = valid_path.read_bytes()
    first = judged(reader, valid_path)  # imports and caches are not the damaged file's
    if first != "read":
        pipe.send((-1, f"the valid file: {first}", 0.0))
        return
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    path = folder / f"damaged{reader.suffix}"
    for k in ks:
        path.write_bytes(damaged(reader, valid, seed, k))
        pipe.send((k, "", 0.0))
        start = time.process_time()
        verdict = judged(reader, path)
        spent = time.process_time() - start
        grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base)
        if spent > CPU_S:
            verdict = f"slow: {spent:.1f} s"
        elif grown > MEMORY_BYTES:
            verdict = f"memory: {grown / 1e6:.0f} MB"
            base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        pipe.send((k, verdict, spent))
    pipe.send((ks.stop, "done", 0.0))


def cpu_seconds(pid: int) -> float:
    """CPU time a process has used so far; 0 where the system does not say."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def fuzz(
    reader: Reader, seed: int, count: int, keep: Path | None, every: int | None = None
) -> tuple[collections.Counter, list[str]]:
    """Verdicts by kind, and the faults in words; told of on the way after ``every`` so many files."""
    kinds: collections.Counter = collections.Counter()
    faults: list[str] = []
    start = 0
    with tempfile.TemporaryDirectory(prefix="glintrack-fuzz-") as scratch:
        while start < count:
            stop = count if every is None else min(count, (start // every + 1) * every)
            start = _stretch(reader, Path(scratch), seed, range(start, stop), kinds, faults, keep)
            if every is not None and start == stop:
                print(f"  {reader.name}, {start} files: {dict(kinds)}", *faults, sep="\n    ", flush=True)
    return kinds, faults


def _stretch(reader, folder, seed, ks, kinds, faults, keep) -> int:
    """Run one child until it is done or has to be ended; the next input to go on with."""
    context = multiprocessing.get_context("fork")
    mine, its = context.Pipe(duplex=False)
    child = context.Process(target=work, args=(reader, folder, seed, ks, (mine, its)), daemon=True)
    child.start()
    its.close()
    now, began, cpu = ks.start, time.monotonic(), 0.0

    def note(verdict: str) -> None:
        kind = verdict.split(":")[0]
        kinds[kind] += 1
        if kind not in ("read", "refused"):
            faults.append(f"{reader.name} #{now}: {verdict}")
            if keep is not None:
                valid = (folder / f"{SEEDLING}{reader.suffix}").read_bytes()
                keep.mkdir(parents=True, exist_ok=True)
                name = f"{reader.name.replace(', ', '-').replace(' ', '-')}-{now}{reader.suffix}"
                (keep / name).write_bytes(damaged(reader, valid, seed, now))

    try:
        while True:
            if mine.poll(0.2):
                try:
                    k, verdict, _ = mine.recv()
                except EOFError:
                    child.join()
                    note(f"crash: exit {child.exitcode}")
                    return now + 1
                if verdict == "done":
                    return ks.stop
                if k < 0:
                    raise SystemExit(f"{reader.name}: {verdict}")
                now = k
                if verdict:
                    note(verdict)
                else:
                    began, cpu = time.monotonic(), cpu_seconds(child.pid)
            elif cpu_seconds(child.pid) - cpu > 2 * CPU_S or time.monotonic() - began > WALL_S:
                note("hang: ended")
                return now + 1
    finally:
        child.kill()
        child.join()
        mine.close()


def main() -> None:
    """Fuzz, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200, help="damaged files a reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", action="append", help="readers whose name contains this; repeatable")
    parser.add_argument("--but", action="append", default=[], help="no files that end so; repeatable")
    parser.add_argument("--keep", type=Path, help="folder for the files that found a fault")
    parser.add_argument("--every", type=int, help="say how it goes after this many files")
    parser.add_argument("--json", type=Path, help="write the counts to this file")
    asked = parser.parse_args()
    told, table = [], {}
    print(f"{'reader':22s} {'read':>6s} {'refused':>8s} {'faults':>7s}")
    for reader in READERS:
        named = asked.only is None or any(word in reader.name for word in asked.only)
        if not named or reader.suffix in asked.but:
            continue
        kinds, faults = fuzz(reader, asked.seed, asked.count, asked.keep, asked.every)
        bad = sum(kinds.values()) - kinds["read"] - kinds["refused"]
        print(f"{reader.name:22s} {kinds['read']:6d} {kinds['refused']:8d} {bad:7d}", flush=True)
        table[reader.name] = dict(kinds)
        told += faults
    print("\n".join(told))
    if asked.json:
        asked.json.write_text(json.dumps(table, indent=1) + "\n")
    sys.exit(1 if told else 0)


if __name__ == "__main__":
    main()
