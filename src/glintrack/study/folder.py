"""The folder of a study: one folder a finished case, tracebacks of failed ones, and whose study it is."""

import json
import os
import shutil
from collections.abc import Iterable, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from glintrack.case.design import Case
from glintrack.io import atomic
from glintrack.io.digest import content_hash
from glintrack.io.toml import to_toml
from glintrack.io.untrusted import is_file, read_json
from glintrack.study.plan import FORMAT, Plan
from glintrack.study.source import DECIDE_SCORES, source_key

try:
    import fcntl
except ImportError:  # not on Windows, where two drivers in one folder are not told apart
    fcntl = None  # type: ignore[assignment]

_HEAD = "study.json"
_SCORES = "scores.json"


class StudyFolder:
    """A study's results on disk.

    Parameters
    ----------
    path
        New, or a folder of the same study, which is then resumed.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._whole: dict[str, dict[str, Any]] = {}  # cases whose files have been held against their hashes

    @contextmanager
    def opened(self, plan: Plan):
        """Hold the folder for one driver; what an earlier one left half written is removed.

        Raises
        ------
        ValueError
            If it is another study's or another version's, holds other files, is in use, or cannot be written.
        """
        self.check(plan)
        try:
            (self.path / "cases").mkdir(parents=True, exist_ok=True)
            lock = (self.path / ".lock").open("w")
        except OSError as error:
            raise ValueError(f"`output` must be writable, got {self.path} ({error.strerror})") from error
        with lock:
            if fcntl is not None:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # freed by the system when a driver dies
                except OSError as error:
                    raise ValueError(
                        f"`output` must not be in use, got {self.path}, where another run writes"
                    ) from error
            for left in (self.path / "cases").glob(".*.partial"):
                shutil.rmtree(left, ignore_errors=True)
            if not (self.path / _HEAD).exists():
                head = {"format": FORMAT, "study": plan.key, "name": plan.design.name}
                head |= {
                    "glintrack": version("glintrack"),
                    "source": source_key(),
                    "points": len(plan.points),
                    "cases": len(plan.cases),
                }
                atomic.write_text(self.path / _HEAD, json.dumps(head, indent=1) + "\n")
            yield self

    def check(self, plan: Plan) -> None:
        """Whether the folder may hold this study.

        Raises
        ------
        ValueError
            If it is another study's or another version's, or holds other files.
        """
        if not self.path.exists():
            return
        if not self.path.is_dir():
            raise ValueError(f"`output` must be a folder, got the file {self.path}")
        names = {p.name for p in self.path.iterdir()} - {".lock", "cases"}
        if not names:
            return
        head = self.head()
        if head["glintrack"] != version("glintrack"):
            raise ValueError(
                f"`output` must be of glintrack {version('glintrack')}, got {self.path} of glintrack "
                f"{head['glintrack']} (choose another -o)"
            )
        if head.get("source") != source_key():
            raise ValueError(
                f"`output` must hold results of the source that runs now, got {self.path} of other source of "
                f"glintrack {head['glintrack']}, or other versions of {', '.join(DECIDE_SCORES)}, also one "
                "installed since: their scores must not mix (choose another -o, or go back; glintrack study "
                "report reads the folder as it is)"
            )
        if head["study"] != plan.key:
            raise ValueError(
                f"`output` must be new or of the same study, got {self.path} of another study, "
                f"{head['name']!r} (choose another -o)"
            )

    def head(self) -> dict[str, Any]:
        """Whose folder it is.

        Raises
        ------
        ValueError
            If it is no study's, or of a newer format.
        """
        try:
            head = read_json(self.path / _HEAD, _HEAD)
            needed = {"format": int, "study": str, "name": str, "glintrack": str}
            if not all(isinstance(head[key], kind) for key, kind in needed.items()):
                raise TypeError
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"`result` must be the folder of a study, got {self.path} (for a new one choose another -o)"
            ) from error
        if head["format"] > FORMAT:
            raise ValueError(
                f"`result` must be of format {FORMAT} or older, got {self.path} of format {head['format']} "
                f"(made by glintrack {head['glintrack']}: update)"
            )
        return head

    def finished(self, case_key: str) -> dict[str, Any] | None:
        """What a finished case told; None if it has to be flown. A folder that is not whole is removed."""
        folder = self.path / "cases" / case_key
        if not folder.exists():
            return None
        if case_key in self._whole:
            return self._whole[case_key]
        try:
            told = read_json(folder / _SCORES, _SCORES)
            files = told["sha256"]
            if all(_is_whole(folder, name, digest) for name, digest in files.items()):
                self._whole[case_key] = told
                return told
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            pass
        shutil.rmtree(folder, ignore_errors=True)
        return None

    def spent(self, case_keys: Iterable[str]) -> dict[str, float]:
        """What the finished of some cases took: ``flights``, ``frames``, ``cpu_s``, on whichever machines."""
        flown = [told for key in case_keys if (told := self.finished(key)) is not None]
        frames = sum(max(of.get("epochs", 0) for of in told["scores"].values()) for told in flown)
        cpu_s = sum(told["cpu_seconds"] for told in flown)
        return {"flights": len(flown), "frames": int(frames), "cpu_s": cpu_s}

    def size(self, case_key: str) -> int:
        """Bytes that a finished case's files take."""
        folder = self.path / "cases" / case_key
        return sum(file.stat().st_size for file in folder.glob("*") if file.is_file())

    def publish(self, case_key: str, told: Mapping[str, Any]) -> None:
        """Give a finished case its folder in one step, on the disk and not only in its cache."""
        target = self.path / "cases" / case_key
        partial = target.with_name(f".{case_key}.partial")
        files = told["files"]
        plain = {name: value for name, value in told.items() if name != "files"}
        plain["sha256"] = {name: content_hash(data) for name, data in files.items()}
        shutil.rmtree(partial, ignore_errors=True)
        try:
            partial.mkdir(parents=True)
            for name, data in {**files, _SCORES: json.dumps(plain, indent=1).encode()}.items():
                with (partial / name).open("wb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
            partial.rename(target)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise

    def note_failure(self, case_key: str, case: Case, error: str, number: int) -> None:
        """Keep the traceback of a case's failed attempt, with the case."""
        folder = self.path / "failed" / case_key
        folder.mkdir(parents=True, exist_ok=True)
        atomic.write_text(folder / "case.toml", to_toml(case))
        atomic.write_text(folder / f"attempt-{number}.txt", error)

    def forget_failure(self, case_key: str) -> None:
        """A case that has failed before is tried anew."""
        shutil.rmtree(self.path / "failed" / case_key, ignore_errors=True)

    def failure(self, case_key: str) -> str | None:
        """Last line of the last traceback kept of a case."""
        found = sorted((self.path / "failed" / case_key).glob("attempt-*.txt"))
        return found[-1].read_text(encoding="utf-8").strip().splitlines()[-1] if found else None


def _is_whole(folder: Path, name: str, digest: str) -> bool:
    """Whether a file of a case's own folder is there as it was written."""
    path = folder / name
    return Path(name).name == name and is_file(path) and content_hash(path.read_bytes()) == digest
