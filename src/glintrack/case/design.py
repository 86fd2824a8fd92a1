"""A case: one design of everything, from one TOML file."""

import math
from collections.abc import Collection, Container, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

from pydantic import Field, field_validator, model_validator

from glintrack.atmosphere import AtmosphereDesign, sun_direction
from glintrack.case.packaged import PACKAGED_CASES, find_case, list_cases
from glintrack.core.designs import Design, suggest_name, validate_design, with_changes
from glintrack.flight import FlightDesign
from glintrack.io.toml import read_toml
from glintrack.scene import SceneDesign
from glintrack.sensor import NavigationDesign, SensorDesign
from glintrack.track import TrackDesign

Located = TypeVar("Located", SceneDesign, SensorDesign)
_WIDEST_FIELD_DEG = 120.0
_STUDY_MARKS = {"axes", "design", "cases", "replicates"}  # keys that only a study has


class OrthoDesign(Design):
    """Rectification; the ``[ortho]`` table of a case."""

    gsd_m: float = Field(default=1.5, gt=0.05, le=50)
    """Cell of the ground grid (Table 1: 0.75 and 1.5)."""
    method: Literal["nearest", "bilinear", "cubic"] = "bilinear"
    """The paper uses nearest."""
    surface: Literal["terrain", "surface"] = "terrain"
    """Terrain alone, or also roofs and crowns: then hidden ground is left out of images."""
    registration: Literal["none", "phase"] = "none"
    """Move frames onto the first one's content by phase correlation."""


class BoundDesign(Design):
    """Design of the loss budget; the ``[bound]`` table of a case."""

    every: int = Field(default=5, ge=0, le=1_000_000)
    """Interval of the frames on which `glintrack run` measures the loss budget; 0 for none."""
    false_per_frame: float = Field(default=20.0, gt=0, le=1000)
    """False detections a frame at which the stages that detect are compared."""


class OutputDesign(Design):
    """Optional output of a run; the ``[output]`` table of a case."""

    keep_frames: int = Field(default=5, ge=0, le=100_000)
    """Number of rectified frames to write as GeoTIFF, evenly spread."""
    film_frames: int = Field(default=150, ge=0, le=3600)
    """Number of frames of the report page's film, evenly spread; 0 for no film."""
    quality: bool = False
    """Compare every frame with its noiseless truth: image, spectra, polarization."""
    boxes: bool = False
    """Write `boxes.csv`: box of each vehicle, also parked ones, in every frame."""


class Case(Design):
    """One design of everything, which ``glintrack run`` simulates."""

    name: str = Field(default="case", min_length=1, max_length=80)
    """Name of figures and folders."""
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    """Seed of all random numbers."""
    channels: tuple[Literal["pan", "dolp", "all"], ...] = Field(default=("pan", "dolp", "all"), min_length=1)
    """Tracking channels; each has its own tracker. `all` uses pan and DoLP, or all elements."""
    scene: SceneDesign = SceneDesign()
    atmosphere: AtmosphereDesign = AtmosphereDesign()
    flight: FlightDesign = FlightDesign()
    sensor: SensorDesign = SensorDesign()
    navigation: NavigationDesign = NavigationDesign()
    ortho: OrthoDesign = OrthoDesign()
    track: TrackDesign = TrackDesign()
    bound: BoundDesign = BoundDesign()
    output: OutputDesign = OutputDesign()

    @field_validator("name")
    @classmethod
    def _name_names_a_folder(cls, name: str) -> str:
        """Refuse names that no file can have on some system."""
        if not name.isprintable() or set(name) & set('/\\<>:"|?*') or name.strip(" .") != name:
            raise ValueError(
                '`name` must be one that a folder can have: printable, without / \\ < > : " | ? *, not '
                f"beginning or ending in a dot or space; got {name!r}."
            )
        return name

    @model_validator(mode="after")
    def _channels_once_each(self) -> Self:
        if len(set(self.channels)) != len(self.channels):
            raise ValueError(f"`channels` must name each at most once; got {list(self.channels)}.")
        return self

    @model_validator(mode="after")
    def _parts_fit_together(self) -> Self:
        """Check the tables against each other."""
        try:
            sun_direction(self.atmosphere)
        except ValueError as error:  # a sun that is not up
            raise ValueError(str(error).replace("`", "`atmosphere.", 1)) from error
        try:  # `auto` is `mosaic` in a case
            self.track.replace({"detect.detector": self.track.detect.detector.replace("auto", "mosaic")})
        except ValueError as error:
            raise ValueError(str(error).replace("`", "`track.", 1)) from error
        limits = {"the highest of atmosphere.altitudes_m": max(self.atmosphere.altitudes_m)}
        if self.atmosphere.cloud_optical_depth:
            limits["atmosphere.cloud_base_m"] = self.atmosphere.cloud_base_m
        for key, highest_m in limits.items():
            if self.flight.kind != "waypoints" and self.flight.altitude_m > highest_m:
                raise ValueError(
                    f"`flight.altitude_m` must be at most {key}, {highest_m:g}; "
                    f"got {self.flight.altitude_m:g}."
                )
        widest_m = max(self.sensor.rows, self.sensor.columns) * self.sensor.pitch_m
        field_deg = math.degrees(2 * math.atan(widest_m / (2e-3 * self.sensor.focal_length_mm)))
        if field_deg > _WIDEST_FIELD_DEG:
            raise ValueError(
                f"`sensor.focal_length_mm` must give a field of view of at most {_WIDEST_FIELD_DEG:g}°; got "
                f"{field_deg:.0f}° for {self.sensor.focal_length_mm:g} mm and {1e3 * widest_m:g} mm of array."
            )
        if self.flight.rate_hz > self.sensor.max_frame_rate_hz:
            raise ValueError(
                f"`flight.rate_hz` must be at most sensor.max_frame_rate_hz, "
                f"{self.sensor.max_frame_rate_hz:g} Hz; got {self.flight.rate_hz:g}."
            )
        queries = self.track.query.policy != "none" and self.sensor.has_mirror
        needed_ms, frame_ms = self.sensor.second_exposure_ends_ms, 1e3 / self.sensor.max_frame_rate_hz
        if queries and self.track.query.at == "detection" and needed_ms > frame_ms:
            raise ValueError(
                f"`track.query.at` must be 'prediction' where frame, mirrors and spectra in turn take "
                f"longer than a frame's {frame_ms:g} ms (see sensor.max_frame_rate_hz); got {needed_ms:g} ms."
            )
        if set(self.channels) != {"pan"} and not self.sensor.has_stokes:
            raise ValueError(
                f"`channels` must be 'pan' alone where the sensor has no polarizers; got "
                f"{list(self.channels)} with layout {self.sensor.layout!r}."
            )
        wavelength_um = self.atmosphere.wavelength_um
        for name in ("band_um", "spectrometer_um") if self.sensor.has_mirror else ("band_um",):
            first, last = getattr(self.sensor, name)
            if first < wavelength_um[0] - 1e-9 or last > wavelength_um[-1] + 1e-9:
                raise ValueError(
                    f"`sensor.{name}` must lie within the atmosphere's {wavelength_um[0]:g} to "
                    f"{wavelength_um[-1]:g} µm; got {first:g} to {last:g}. "
                    "Set atmosphere.wavelength_stop_um to extend it."
                )
        return self

    @classmethod
    def from_name(cls, name: str) -> "Case":
        """Read a packaged case, such as ``"quickstart"``.

        Raises
        ------
        ValueError
            If there is none of this name; the message lists them.
        """
        if name not in list_cases():
            raise ValueError(
                f"`name` must be a packaged case ({', '.join(list_cases())}); got {name!r}. "
                "Read a file with Case.from_toml."
            )
        return cls.from_toml(find_case(name))

    @classmethod
    def from_toml(
        cls, path: str | Path, allow_outside_paths: bool = False, changes: Mapping[str, Any] | None = None
    ) -> "Case":
        """Read a case.

        Parameters
        ----------
        path
            TOML file.
        allow_outside_paths
            Allow paths of files outside the case's folder; for cases that you trust.
        changes
            Values that replace those of the file, as for `replace`. Their file paths are relative to the
            working folder, and may be outside the case's.

        Raises
        ------
        ValueError
            In one sentence: the fault of the file, a key (the nearest known one is suggested) or a value.
        """
        values, folder, own = read_case(path), Path(path).parent, changes or {}
        case = validate_design(cls, with_changes(values, own))
        located = case._locate(folder, None if allow_outside_paths else (folder,), own)
        return located.replace(own) if own else located  # with the paths of changes as given

    @classmethod
    def from_values(cls, values: dict, folder: Path, inside: Sequence[Path] | None = None) -> "Case":
        """Build a case from plain values.

        Parameters
        ----------
        values
            As a case's file has them.
        folder
            Folder that relative file paths start from.
        inside
            Folders that must contain every file; None for no restriction.

        Raises
        ------
        ValueError
            In one sentence: the fault of a key or a value.
        """
        return validate_design(cls, values)._locate(folder, inside)

    def _locate(self, folder: Path, inside: Sequence[Path] | None, free: Container[str] = ()) -> "Case":
        """Case with paths relative to a folder; files of ``free`` keys may be outside ``inside``."""
        parts = {"scene": self.scene, "flight": self.flight, "sensor": self.sensor}
        located = {name: part.resolve_files(folder) for name, part in parts.items()}
        if inside is not None:
            folders = [one.resolve() for one in inside]
            for name, part in parts.items():
                if name not in free:
                    _check_inside(name, part, located[name], folders, free)
        return self.model_copy(update=located)


def read_case(path: str | Path) -> dict[str, Any]:
    """Read the values of a case file, over those of the packaged case that it names as ``like``.

    Raises
    ------
    ValueError
        If the file is none, is a study's, or ``like`` names no packaged case.
    """
    values = {"name": Path(path).stem, **read_toml(path, "case")}
    if _STUDY_MARKS & set(values):
        name = Path(path).stem if Path(path).parent == PACKAGED_CASES else path
        raise ValueError(f"`case` must be a case; got the study {name}. Run `glintrack study {name}`.")
    for key in ("case", "base"):
        if key in values:
            raise ValueError(f"`{key}` must not be in a case (`like` names its base); got it in {path}.")
    return over_like(values)


def over_like(values: dict[str, Any]) -> dict[str, Any]:
    """Values of a case, over those of the packaged case that they name as ``like``."""
    if "like" not in values:
        return values
    like, known = values["like"], list_cases()
    if like not in known:
        raise ValueError(f"`like` must name a packaged case ({', '.join(known)}); got {str(like)[:80]!r}.")
    below = read_toml(PACKAGED_CASES / f"{like}.toml", "like")
    return _merge(below, {key: value for key, value in values.items() if key != "like"})


def _merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Merge nested tables; values of ``above`` replace those of ``below``."""
    out = {**below, **above}
    for key, value in above.items():
        if isinstance(value, dict) and isinstance(below.get(key), dict):
            out[key] = _merge(below[key], value)
    return out


def read_table(model: type[Located], name: str, table: str, key: str, packaged: Collection[str]) -> Located:
    """Read one table of a case, or a packaged design by its name.

    Parameters
    ----------
    model
        Design of the table.
    name
        TOML file with the table, name of a packaged case, or one of ``packaged``.
    table
        Name of the table.
    key, packaged
        Key that selects a packaged design, and its values.

    Raises
    ------
    ValueError
        If there is no such design or file, or the file has no such table.
    """
    is_name = not Path(name).exists()
    if is_name and name in packaged:
        return validate_design(model, {key: name})
    if is_name and not Path(name).suffix and name not in list_cases():
        hint = suggest_name(name, [*packaged, *list_cases()])
        raise ValueError(f"`{table}` must be a packaged {table} or case, or a TOML file; got {name}. {hint}")
    path = find_case(name)
    values = over_like(read_toml(path, table)).get(table)
    if not isinstance(values, dict):
        raise ValueError(f"`{table}` must be a TOML file with a [{table}] table; got none in {name}.")
    return validate_design(model, values).resolve_files(path.parent)


def _check_inside(
    table: str, given: Design, located: Design, folders: list[Path], free: Container[str]
) -> None:
    """Refuse file paths of a table outside some folders, except those of ``free`` keys."""
    for key in type(given).model_fields:
        before, after = getattr(given, key), getattr(located, key)
        if f"{table}.{key}" in free:
            continue
        if isinstance(after, Design):
            _check_inside(f"{table}.{key}", before, after, folders, free)
        elif not isinstance(after, str) or not Path(after).is_absolute():  # no file
            continue
        elif not any(Path(after).is_relative_to(one) for one in folders):
            raise ValueError(
                f"`{table}.{key}` must name a file in the case's folder or below; got {before}. "
                "--allow-outside-paths allows others."
            )
