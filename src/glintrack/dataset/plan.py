"""What a set is made of: its cases, which split each city falls into, and its shards; the standard set."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from itertools import product

from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.core.installation import VERSION
from glintrack.io.atomic import content_hash
from glintrack.io.toml import to_toml

SPLITS = ("train", "val", "test")
STANDARD = "standard"
MOST_SHARD_FRAMES = 1000
STANDARD_FRAMES = 20
_SLANT_RANGE_M = 3000.0
_OFF_NADIR_DEG = (20.0, 35.0, 50.0)
_HAZES = ("clear", "urban")
_SUMO = "sumo:tools/game/"
# the embedded city's five seeds share its streets and traffic, and are therefore one city to `split_by_city`
STANDARD_CITIES: dict[str, dict] = {
    **{f"embedded-{seed}": {"city": "embedded", "seed": seed} for seed in range(1, 6)},
    "braunschweig": {"city": "braunschweig"},
    "berlin": {"city": "net", "net_file": f"{_SUMO}DRT/osm.net.xml"},
    "wildau": {
        "city": "net",
        "net_file": f"{_SUMO}A10KW/osm.net.xml",
        "polygons_file": f"{_SUMO}A10KW/osm.poly.xml",
    },
}
_BITS = 16  # of a raw's file


@dataclass(frozen=True)
class Shard:
    """Some consecutive frames of a case, which are flown, written and checked together.

    Parameters
    ----------
    case, number, frames
        The design, which of its shards, and which of its frames.
    """

    case: Case
    number: int
    frames: range

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.case.name}-{self.number:03d}"

    @property
    def key(self) -> str:
        """Of all that decides what its files hold."""
        frames = f"{self.frames.start}-{self.frames.stop}"
        return content_hash([VERSION, to_toml(self.case), frames], 32)


@dataclass(frozen=True)
class DatasetPlan:
    """Cases by name, the split of each, and the frames of a shard."""

    cases: dict[str, Case]
    split: dict[str, str]
    shard_frames: int = 10

    def shards(self, name: str) -> list[Shard]:
        """Those of one case."""
        case, step = self.cases[name], self.shard_frames
        starts = range(0, case.flight.frames, step)
        return [
            Shard(case, k, range(start, min(start + step, case.flight.frames)))
            for k, start in enumerate(starts)
        ]

    @property
    def key(self) -> str:
        """Of the whole set."""
        parts = [f"{n} {self.split[n]} {s.key}" for n in sorted(self.cases) for s in self.shards(n)]
        return content_hash(parts, 32)

    @property
    def frames(self) -> int:
        """Of all cases."""
        return sum(case.flight.frames for case in self.cases.values())

    @property
    def most_bytes(self) -> int:
        """Of all files before compression: raws, light and rectified channels in single precision."""
        return sum(case.flight.frames * _frame_bytes(case) for case in self.cases.values())


def _frame_bytes(case: Case) -> int:
    sensor, (wide, high) = case.sensor, case.scene.size_m
    elements = sensor.rows * sensor.columns
    cells = math.ceil(wide / case.ortho.gsd_m) * math.ceil(high / case.ortho.gsd_m)
    return 2 * elements + 4 * elements + 12 * elements // len(sensor.superpixel) ** 2 + 20 * cells


def plan_dataset(
    cases: Sequence[Case | str],
    frames: int | None = None,
    shard_frames: int = 10,
    allow_outside_paths: bool = False,
) -> DatasetPlan:
    """The plan of a set.

    Parameters
    ----------
    cases
        Designs, files, packaged cases by name, ``standard`` for the standard set, or ``standard/PATTERN`` for
        those of its cases whose names match, as ``standard/*-clear``.
    frames
        Of each case, instead of its own.
    shard_frames
        Frames flown and written together.
    allow_outside_paths
        As of `Case.from_toml`.

    Raises
    ------
    ValueError
        If two cases have one name, or one has an exposure that follows the light, or more bits than raws.
    """
    if not 1 <= shard_frames <= MOST_SHARD_FRAMES:
        raise ValueError(f"`shard-frames` must lie within 1 to {MOST_SHARD_FRAMES}, got {shard_frames}")
    if frames is not None and not 1 <= frames <= 100_000:
        raise ValueError(f"`frames` must lie within 1 to 100000, got {frames}")
    designs: list[Case] = []
    for one in cases:
        if isinstance(one, Case):
            designs.append(one)
        else:
            designs += (
                _standard(one) if _is_standard(one) else [Case.from_toml(find_case(one), allow_outside_paths)]
            )
    if frames is not None:
        designs = [case.replace({"flight.frames": frames}) for case in designs]
    names = [case.name for case in designs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice or not names:
        raise ValueError(f"`CASE` must be named once each, got {f'{twice[0]!r} twice' if twice else 'none'}")
    for case in designs:
        _check(case)
    found = dict(zip(names, designs, strict=True))
    parts = any(isinstance(one, str) and _is_standard(one) for one in cases)
    whole = {case.name: case for case in standard_cases()} if parts else {}
    split = split_by_city({**whole, **found})  # a part of the standard set keeps the splits of the whole
    return DatasetPlan(found, {name: split[name] for name in names}, shard_frames)


def _is_standard(name: str) -> bool:
    return name.split("/", 1)[0] == STANDARD


def _standard(name: str) -> list[Case]:
    """The standard set, or a part of it."""
    pattern = name.removeprefix(STANDARD).removeprefix("/") or "*"
    chosen = [case for case in standard_cases() if fnmatchcase(case.name, pattern)]
    if not chosen:
        raise ValueError(
            f"`CASE` must match a case of the standard set, as {STANDARD}/*-clear or {STANDARD}/wildau-*, "
            f"got {name!r}"
        )
    return chosen


def _check(case: Case) -> None:
    if case.sensor.auto_exposure.quantile > 0:
        raise ValueError(
            "`sensor.auto_exposure.quantile` must be 0 in a set, whose frames are flown each for itself, got "
            f"{case.sensor.auto_exposure.quantile:g} in {case.name}"
        )
    if case.sensor.bits > _BITS:
        raise ValueError(
            f"`sensor.bits` must be at most {_BITS} in a set, whose raws are files of so many, got "
            f"{case.sensor.bits} in {case.name}"
        )


def city_of(case: Case) -> str:
    """Which city a case flies over: one network, one mesh or one embedded plan, wherever its window lies."""
    scene = case.scene
    source = scene.net_file or scene.osm_file or scene.mesh_file
    if source is None and scene.city == "embedded":
        source = "{:g} x {:g} m".format(*scene.size_m)
    return scene.city if source is None else f"{scene.city} {source}"


def split_by_city(cases: dict[str, Case]) -> dict[str, str]:
    """Which split each case falls into: all of a city into one, so that no test was seen in training.

    Cities in the order of their first case: of n cities the last quarter (one at least) is for testing, as
    many before it for validation from three cities on, the rest for training. One city alone is for training.
    """
    cities = list(dict.fromkeys(city_of(case) for case in cases.values()))
    held = max(1, round(len(cities) / 4)) if len(cities) > 1 else 0
    validated = held if len(cities) > 2 else 0
    last = len(cities) - held
    of_city = {
        city: "test" if k >= last else "val" if k >= last - validated else "train"
        for k, city in enumerate(cities)
    }
    return {name: of_city[city_of(case)] for name, case in cases.items()}


@cache
def standard_cases() -> tuple[Case, ...]:
    """The standard set: eight scenes at three angles off nadir in two hazes, the quickstart's sensor.

    The embedded city of five seeds and Braunschweig train, Berlin validates, Wildau tests. The real networks
    need SUMO (extra `traffic`).
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
