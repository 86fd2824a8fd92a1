"""Build a data set shard by shard; a build resumes where it stopped."""

from collections.abc import Callable
from pathlib import Path

from glintrack.case.build import build_scenario
from glintrack.case.design import Case
from glintrack.case.identity import case_key
from glintrack.core.installation import VERSION, require_extra
from glintrack.dataset.annotations import datasheet, write_annotations
from glintrack.dataset.plan import MAX_SHARD_FRAMES, SPLITS, DatasetPlan, Shard, city_of
from glintrack.dataset.shards import FOLDERS, LabelledFrame, file_hash, is_done, simulate_frames, write_shard
from glintrack.io.atomic import content_hash, write_text
from glintrack.io.toml import read_toml, to_toml

ABOUT, SUMS = "dataset.toml", "SHA256SUMS"


def build_dataset(
    plan: DatasetPlan, folder: str | Path, progress: Callable[[Shard, int], None] | None = None
) -> int:
    """Simulate the missing shards of a set and write its labels, as ``glintrack dataset`` does.

    Parameters
    ----------
    plan
        From `plan_dataset`.
    folder
        New, empty, or with a part of the same set.
    progress
        Called after each frame with its shard and the number of frames so far.

    Returns
    -------
    Number of simulated frames.

    Raises
    ------
    ValueError
        If the folder holds another set or other things, or the extra that writes masks is missing.
    """
    folder = Path(folder)
    require_extra("pycocotools.mask", "dataset", "write masks for COCO")
    _open_folder(folder, plan)
    count = 0
    for name, case in plan.cases.items():
        missing = [shard for shard in plan.shards(name) if not is_done(folder, shard)]
        if not missing:
            continue
        scenario = build_scenario(case)
        for shard in missing:
            frames: list[LabelledFrame] = []
            for frame in simulate_frames(case, scenario, shard.frames):
                frames.append(frame)
                count += 1
                if progress is not None:
                    progress(shard, count)
            write_shard(folder, shard, frames)
    boxes = write_annotations(folder, plan)
    write_text(folder / "datasheet.md", datasheet(plan, boxes))
    names = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and p.name != SUMS)
    write_text(folder / SUMS, "".join(f"{file_hash(folder / name)}  {name}\n" for name in names))
    return count


def _open_folder(folder: Path, plan: DatasetPlan) -> None:
    """Create the folder of a set, or raise ValueError if it holds another set or other files."""
    about = folder / ABOUT
    inputs = content_hash([case_key(case) for case in plan.cases.values()], 32)
    if about.is_file():
        found = read_toml(about, "dataset")
        if found.get("key") != plan.key or found.get("inputs") != inputs:
            raise ValueError(
                "`output` must be new, or hold a set of the same cases, files and program; got "
                f"{folder} with another. Choose another -o."
            )
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"`output` must be a new or empty folder; got {folder}. Choose another -o.")
    try:
        for inner in FOLDERS:
            (folder / inner).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"`output` must be writable; got {folder}: {error.strerror}.") from error
    for name, case in plan.cases.items():
        write_text(folder / "cases" / f"{name}.toml", to_toml(case))
    of_case = {name: {"split": plan.split[name], "city": city_of(case)} for name, case in plan.cases.items()}
    values = {"key": plan.key, "inputs": inputs, "version": VERSION, "shard_frames": plan.shard_frames}
    write_text(about, to_toml(values | {"cases": of_case}))


def read_plan(folder: str | Path, allow_outside_paths: bool = False) -> DatasetPlan:
    """Read the plan of a set that was built.

    Parameters
    ----------
    folder
        Folder of the set.
    allow_outside_paths
        See `Case.from_toml`; for cases with files outside the set.

    Raises
    ------
    ValueError
        If the folder holds no set, or not all of it.
    """
    folder = Path(folder)
    if not (folder / ABOUT).is_file():
        raise ValueError(f"`DATASET` must be a folder that `glintrack dataset` wrote; got {folder}.")
    split, shard_frames = read_about(folder / ABOUT)
    cases = {name: Case.from_toml(folder / "cases" / f"{name}.toml", allow_outside_paths) for name in split}
    if any(case.name != name for name, case in cases.items()):
        raise ValueError(f"`DATASET` must have files of cases by their names; got others in {folder}.")
    plan = DatasetPlan(cases, split, shard_frames)
    for name in cases:
        for shard in plan.shards(name):
            if not is_done(folder, shard):
                raise ValueError(
                    f"`DATASET` must be whole and of this version; got {folder} without shard {shard.name}."
                )
    return plan


def read_about(path: Path) -> tuple[dict[str, str], int]:
    """Read the split of each case by its name, and the frames of a shard, from a set's ``dataset.toml``.

    Raises
    ------
    ValueError
        If one is missing or wrong.
    """
    about = read_toml(path, "dataset")
    named, frames = about.get("cases"), about.get("shard_frames")
    if not isinstance(named, dict) or not named or not all(isinstance(v, dict) for v in named.values()):
        raise ValueError(f"`DATASET` must name its cases; got none in {path}.")
    if type(frames) is not int or not 1 <= frames <= MAX_SHARD_FRAMES:
        raise ValueError(f"`DATASET` must have shard_frames of 1 to {MAX_SHARD_FRAMES}; got {frames!r}.")
    split = {name: one.get("split") for name, one in named.items()}
    if any(one not in SPLITS or Path(name).name != name for name, one in split.items()):
        raise ValueError(f"`DATASET` must have cases of a split ({', '.join(SPLITS)}); got others in {path}.")
    return {name: str(one) for name, one in split.items()}, frames
