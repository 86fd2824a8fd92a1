"""Every command that writes, on a disk that is full, read-only, of small files, or gone while it writes."""

import shutil
import threading
from pathlib import Path

import pytest

from tests.architecture.test_commands import CALLED
from tests.fuzz.caller import Caller
from tests.fuzz.calls import CALLS, Call, write_files
from tests.fuzz.disks import mounted
from tests.fuzz.judge import fault_of_call

pytest.importorskip("resource", reason="limits and mounts of POSIX systems")
SMALL = 6000  # what the commands say fits, most files that they write do not
WRITE_NOTHING = {
    *("case check", "case list", "case schema", "dataset baseline", "sensor ghosts", "sensor list", "view"),
    "warm-up",
}
WRITES_INTO_ITS_INPUT = {"study report"}
WRITES_A_STUDY = {"optimize"}  # as `study run` does, with the same functions
writing = [call for call in CALLS if call.writes]


def writes_many_files(call: Call) -> bool:
    """Whether the first of a call's files may fit where the others do not."""
    return len(call.writes) > 1 or "--plot" in call.arguments or not Path(call.writes[0]).suffix


every_writing_call = pytest.mark.parametrize(
    "call", writing, ids=[f"{c.command} {c.writes[0]}" for c in writing]
)


def test_every_command_has_a_call():
    """A new command gets its row in `CALLS`, and is tried here."""
    assert {call.command for call in CALLS} == set(CALLED)
    kept_apart = WRITE_NOTHING | WRITES_INTO_ITS_INPUT | WRITES_A_STUDY
    assert {call.command for call in writing} == set(CALLED) - kept_apart


@pytest.fixture(scope="module")
def caller():
    with Caller() as caller:
        yield caller


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    write_files(folder)
    return folder


def words_of(call: Call, inputs: Path, outputs: Path) -> list[str]:
    """What is typed; a cache of a study's own lies elsewhere."""
    places = {"@": inputs, ">": outputs}
    out = [str(places[w[0]] / w[1:]) if w[0] in places else w for w in call.arguments]
    return [*call.command.split(), *out]


RESUMED = ("dataset build",)  # keep a folder with what is done, and go on there when called again


def refused(came, disk: Path, also=()):
    """One sentence, exit 2 (1 of a study whose cases failed), and nothing left."""
    assert came.code in (2, *also), (came.code, came.err[-1500:])
    assert came.code != 2 or fault_of_call(came.code, came.out, came.err) == ""
    assert "Traceback" not in came.err
    left = [p.name for p in disk.rglob("*") if "partial" in p.name]
    assert left == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("call", "room"),
    [(call, "4k") for call in writing] + [(call, "40k") for call in writing if writes_many_files(call)],
    ids=lambda value: f"{value.command} {value.writes[0]}" if isinstance(value, Call) else value,
)
def test_on_a_full_disk(caller, inputs, tmp_path, call, room):
    with mounted(tmp_path / "disk", f"size={room}") as disk:
        came = caller.call(words_of(call, inputs, disk), tmp_path)
        if came.code == 0:  # it is small enough: then whole
            assert all((disk / name).stat().st_size for name in call.writes)
        else:
            refused(came, disk, (1,) if call.command == "study run" else ())
            one = len(call.writes) == 1 and "--plot" not in call.arguments  # of several some may be whole
            if one and call.command not in RESUMED:
                assert not (disk / call.writes[0]).exists(), came.err


@pytest.mark.slow
@every_writing_call
def test_on_a_read_only_disk(caller, inputs, tmp_path, call):
    with mounted(tmp_path / "disk", "size=1M,ro") as disk:
        refused(caller.call(words_of(call, inputs, disk), tmp_path), disk)


@pytest.mark.slow
@every_writing_call
def test_where_files_must_be_small(caller, inputs, tmp_path, call):
    disk = tmp_path / "disk"
    disk.mkdir()
    came = caller.call(words_of(call, inputs, disk), tmp_path, largest_file=SMALL)
    if came.code == 0:
        assert all((disk / name).stat().st_size <= SMALL for name in call.writes)
    else:
        refused(came, disk, (1,) if call.command == "study run" else ())


@pytest.mark.slow
@every_writing_call
def test_where_the_folder_goes_while_it_is_written(caller, inputs, tmp_path, call):
    disk, over = tmp_path / "disk", threading.Event()
    disk.mkdir()

    def remove() -> None:
        while not over.wait(0.002):
            if disk.is_dir() and any(disk.iterdir()):
                shutil.rmtree(disk, ignore_errors=True)

    remover = threading.Thread(target=remove)
    remover.start()
    try:
        came = caller.call(words_of(call, inputs, disk), tmp_path)
    finally:
        over.set()
        remover.join()
    assert came.code == 0 or fault_of_call(came.code, came.out, came.err) == "" or came.code == 1
    assert "Traceback" not in came.err
