"""Plan of a data set: its cases, the split of each city, and its shards; the standard set."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from itertools import product

from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.core.installation import VERSION, read_data
from glintrack.io.atomic import content_hash
from glintrack.io.toml import to_toml

SPLITS = ("train", "val", "test")
STANDARD = "standard"
MAX_SHARD_FRAMES = 1000
STANDARD_FRAMES = 20
_SLANT_RANGE_M = 3000.0
_OFF_NADIR_DEG = (20.0, 35.0, 50.0)
_HAZES = ("clear", "urban")
# the embedded city's five seeds share its streets and traffic: one city to `split_by_city`
STANDARD_CITIES: Mapping[str, dict] = read_data("cities.toml")["standard"]
_BITS = 16  # of a raw's file


@dataclass(frozen=True)
class Shard:
    """Some consecutive frames of a case, which are simulated, written and checked together.

    Parameters
    ----------
    case, number, frames
        The design, the index of the shard, and its frames.
    """

    case: Case
    number: int
    frames: range

    @property
    def name(self) -> str:
        """Stem of its file names."""
        return f"{self.case.name}-{self.number:03d}"

    @property
    def key(self) -> str:
        """Hash of everything that determines its files."""
        frames = f"{self.frames.start}-{self.frames.stop}"
        return content_hash([VERSION, to_toml(self.case), frames], 32)

    def file(self, ending: str) -> str:
        """Path in the set: ``nc`` (arrays), ``boxes.csv``, ``truth.csv``, or ``toml`` (key and hashes)."""
        return f"shards/{self.name}.{ending}"

    def raw(self, frame: int) -> str:
        """Path of a frame's raw PNG; numbers from 1, as in MOTChallenge."""
        return f"raw/{self.case.name}/{frame + 1:06d}.png"

    @property
    def files(self) -> list[str]:
        """Paths of all files with a hash."""
        return [*map(self.file, ("nc", "boxes.csv", "truth.csv")), *(self.raw(k) for k in self.frames)]


@dataclass(frozen=True)
class DatasetPlan:
    """Cases by name, the split of each, and the frames of a shard."""

    cases: dict[str, Case]
    split: dict[str, str]
    shard_frames: int = 10

    def shards(self, name: str) -> list[Shard]:
        """Shards of one case."""
        case, step = self.cases[name], self.shard_frames
        starts = range(0, case.flight.frames, step)
        return [
            Shard(case, k, range(start, min(start + step, case.flight.frames)))
            for k, start in enumerate(starts)
        ]

    def names(self, split: str) -> list[str]:
        """Cases of a split.

        Raises
        ------
        ValueError
            If it has none.
        """
        found = [name for name in self.cases if self.split[name] == split]
        if not found:
            known = ", ".join(sorted(set(self.split.values())))
            raise ValueError(f"`split` must be one that the set has ({known}); got {split!r}.")
        return found

    @property
    def key(self) -> str:
        """Hash of the whole set."""
        parts = [f"{n} {self.split[n]} {s.key}" for n in sorted(self.cases) for s in self.shards(n)]
        return content_hash(parts, 32)

    @property
    def frames(self) -> int:
        """Number of frames of all cases."""
        return sum(case.flight.frames for case in self.cases.values())

    @property
    def max_size_bytes(self) -> int:
        """Size of all files before compression: raws, light and rectified channels in single precision."""
        total = 0
        for case in self.cases.values():
            sensor, (wide, high) = case.sensor, case.scene.size_m
            elements = sensor.rows * sensor.columns
            cells = math.ceil(wide / case.ortho.gsd_m) * math.ceil(high / case.ortho.gsd_m)
            light = 12 * elements // len(sensor.superpixel) ** 2
            total += case.flight.frames * (2 * elements + 4 * elements + light + 20 * cells)
        return total


def plan_dataset(
    cases: Sequence[Case | str],
    frames: int | None = None,
    shard_frames: int = 10,
    allow_outside_paths: bool = False,
) -> DatasetPlan:
    """Plan a data set.

    Parameters
    ----------
    cases
        Designs, files, packaged cases by name, ``standard`` for the standard set, or ``standard/PATTERN`` for
        its cases with matching names, as ``standard/*-clear``.
    frames
        Number of frames of each case, instead of its own.
    shard_frames
        Number of frames of a shard.
    allow_outside_paths
        See `Case.from_toml`.

    Raises
    ------
    ValueError
        If two cases have one name, or one has an exposure that follows the light, or more bits than raws.
    """
    if not 1 <= shard_frames <= MAX_SHARD_FRAMES:
        raise ValueError(f"`shard-frames` must lie within 1 to {MAX_SHARD_FRAMES}; got {shard_frames}.")
    if frames is not None and not 1 <= frames <= 100_000:
        raise ValueError(f"`frames` must lie within 1 to 100000; got {frames}.")
    designs: list[Case] = []
    whole: dict[str, Case] = {}
    for one in cases:
        if isinstance(one, Case):
            designs.append(one)
        elif one.split("/", 1)[0] != STANDARD:
            designs.append(Case.from_toml(find_case(one), allow_outside_paths))
        else:
            whole = {case.name: case for case in standard_cases()}
            pattern = one.removeprefix(STANDARD).removeprefix("/") or "*"
            chosen = [case for name, case in whole.items() if fnmatchcase(name, pattern)]
            if not chosen:
                raise ValueError(
                    f"`CASE` must match a case of the standard set, as {STANDARD}/*-clear or "
                    f"{STANDARD}/wildau-*; got {one!r}."
                )
            designs += chosen
    if frames is not None:
        designs = [case.replace({"flight.frames": frames}) for case in designs]
    names = [case.name for case in designs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice or not names:
        raise ValueError(f"`CASE` must be named once each; got {f'{twice[0]!r} twice' if twice else 'none'}.")
    for case in designs:
        quantile, bits = case.sensor.auto_exposure.quantile, case.sensor.bits
        if quantile > 0:
            raise ValueError(
                "`sensor.auto_exposure.quantile` must be 0 in a set, where each frame is independent; got "
                f"{quantile:g} in {case.name}."
            )
        if bits > _BITS:
            raise ValueError(
                f"`sensor.bits` must be at most {_BITS} in a set, the depth of its files; got {bits} in "
                f"{case.name}."
            )
    found = dict(zip(names, designs, strict=True))
    split = split_by_city({**whole, **found})  # a part of the standard set has the splits of the whole
    return DatasetPlan(found, {name: split[name] for name in names}, shard_frames)


def city_of(case: Case) -> str:
    """Name of the city of a case: one network, one mesh or one embedded plan, for any window."""
    scene = case.scene
    source = scene.net_file or scene.osm_file or scene.mesh_file
    if source is None and scene.city == "embedded":
        source = "{:g} x {:g} m".format(*scene.size_m)
    return scene.city if source is None else f"{scene.city} {source}"


def split_by_city(cases: dict[str, Case]) -> dict[str, str]:
    """Assign cases to splits by city, so that no city of the test split is in training.

    In the order of their first case, the last quarter of the cities (at least one) is for testing. With three
    or more cities, as many before them are for validation. The rest is for training, also a single city.
    """
    cities = list(dict.fromkeys(city_of(case) for case in cases.values()))
    count = max(1, round(len(cities) / 4)) if len(cities) > 1 else 0
    ends = ["val"] * (count if len(cities) > 2 else 0) + ["test"] * count
    splits = ["train"] * (len(cities) - len(ends)) + ends
    of_city = dict(zip(cities, splits, strict=True))
    return {name: of_city[city_of(case)] for name, case in cases.items()}


@cache
def standard_cases() -> tuple[Case, ...]:
    """List the standard set: eight scenes at three angles off nadir in two hazes, the quickstart's sensor.

    The embedded city of five seeds and Braunschweig are for training, Berlin is for validation, Wildau for
    testing. The real networks need SUMO (extra `traffic`).
    """
    base = Case.from_toml(find_case("quickstart"))
    cases = []
    for (city, scene), angle, haze in product(STANDARD_CITIES.items(), _OFF_NADIR_DEG, _HAZES):
        changes = {
            "name": f"{city}-{angle:.0f}-{haze}",
            "seed": 1000 + len(cases),
            **{f"scene.{key}": value for key, value in scene.items()},
            "atmosphere.aerosol": haze,
            "flight.off_nadir_deg": angle,
            "flight.altitude_m": round(_SLANT_RANGE_M * math.cos(math.radians(angle)), 1),
            "flight.frames": STANDARD_FRAMES,
        }
        cases.append(base.replace(changes))
    return tuple(cases)
