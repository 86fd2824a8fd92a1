"""A case: one design of everything, from one TOML file."""

import difflib
import tomllib
from pathlib import Path
from typing import Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from glintrack.atmosphere import AtmosphereDesign, sun_direction
from glintrack.flight import FlightDesign
from glintrack.scene import SceneDesign
from glintrack.sensor import NavigationDesign, SensorDesign
from glintrack.track import TrackDesign

Model = TypeVar("Model", bound=BaseModel)
_PACKAGED_CASES = Path(__file__).parent / "data" / "cases"


class OrthoDesign(BaseModel):
    """Rectification; the ``[ortho]`` table of a case."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    gsd_m: float = Field(
        default=1.5, gt=0.05, le=50, description="Cell of the ground grid (Table 1: 0.75 and 1.5)"
    )
    method: Literal["nearest", "bilinear", "cubic"] = Field(
        default="bilinear", description="The paper uses nearest"
    )
    surface: Literal["terrain", "surface"] = Field(
        default="terrain",
        description="What may hide the ground: nothing, or roofs and crowns: images then leave out what lies "
        "behind them",
    )
    registration: Literal["none", "phase"] = Field(
        default="none", description="Move frames onto the first one's content by phase correlation"
    )


class OutputDesign(BaseModel):
    """What a run writes beside tracks and scores; the ``[output]`` table of a case."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    keep_frames: int = Field(
        default=5, ge=0, description="How many rectified frames to write as GeoTIFF, evenly spread"
    )
    film_frames: int = Field(
        default=150,
        ge=0,
        le=3600,
        description="How many frames the film of the report page has, evenly spread; 0 for no film. "
        "Each costs about what shading a frame does",
    )
    quality: bool = Field(
        default=False,
        description="Hold every frame against its noiseless truth: picture, spectra, polarization",
    )


class Case(BaseModel):
    """One design, flown once: what ``glintrack run`` reads."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(default="case", min_length=1, max_length=80)
    seed: int = Field(default=0, ge=0, le=2**63 - 1, description="Root of every random draw")
    modalities: tuple[Literal["pan", "dolp", "fused", "adaptive"], ...] = Field(
        default=("pan", "dolp"),
        min_length=1,
        description="What change detection looks at; each closes its own loop. `fused` is one statistic of "
        "both, `adaptive` the one of both that serves better at the time",
    )
    scene: SceneDesign = SceneDesign()
    atmosphere: AtmosphereDesign = AtmosphereDesign()
    flight: FlightDesign = FlightDesign()
    sensor: SensorDesign = SensorDesign()
    navigation: NavigationDesign = NavigationDesign()
    ortho: OrthoDesign = OrthoDesign()
    track: TrackDesign = TrackDesign()
    output: OutputDesign = OutputDesign()

    @model_validator(mode="after")
    def _modalities_once_each(self) -> Self:
        if len(set(self.modalities)) != len(self.modalities):
            raise ValueError(f"`modalities` must name each at most once, got {list(self.modalities)}")
        return self

    @model_validator(mode="after")
    def _parts_fit_together(self) -> Self:
        """What no part can check alone, found before anything is built."""
        try:
            sun_direction(self.atmosphere)
        except ValueError as error:  # a sun that is not up
            raise ValueError(str(error).replace("`", "`atmosphere.", 1)) from error
        low, high = min(self.atmosphere.altitudes_m), max(self.atmosphere.altitudes_m)
        if self.flight.kind != "waypoints" and not low <= self.flight.altitude_m <= high:
            raise ValueError(
                f"`flight.altitude_m` must lie within atmosphere.altitudes_m, {low:g} to {high:g} m, "
                f"got {self.flight.altitude_m:g}"
            )
        if self.flight.rate_hz > self.sensor.clock_hz:
            raise ValueError(
                f"`flight.rate_hz` must be at most sensor.clock_hz, {self.sensor.clock_hz:g} Hz, "
                f"got {self.flight.rate_hz:g}"
            )
        asks = self.track.query_policy != "none" and self.sensor.has_mirror
        needed_ms, frame_ms = self.sensor.second_exposure_ends_ms, 1e3 / self.sensor.clock_hz
        if asks and self.track.query_at == "detection" and needed_ms > frame_ms:
            raise ValueError(
                f"`track.query_at` must be 'prediction' where frame, mirrors and spectra in turn "
                f"take longer than a frame's {frame_ms:g} ms (see sensor.clock_hz), got {needed_ms:g} ms"
            )
        if set(self.modalities) != {"pan"} and not self.sensor.has_stokes:
            raise ValueError(
                f"`modalities` must be 'pan' alone where the sensor has no polarizers, got "
                f"{list(self.modalities)} with layout {self.sensor.layout!r}"
            )
        wavelength_um = self.atmosphere.wavelength_um
        for name in ("band_um", "spectrometer_um"):
            first, last = getattr(self.sensor, name)
            if first < wavelength_um[0] - 1e-9 or last > wavelength_um[-1] + 1e-9:
                raise ValueError(
                    f"`sensor.{name}` must lie within the atmosphere's {wavelength_um[0]:g} to "
                    f"{wavelength_um[-1]:g} µm, got {first:g} to {last:g} (see atmosphere.wavelength_stop_um)"
                )
        return self

    @classmethod
    def from_toml(cls, path: str | Path) -> "Case":
        """Read a case.

        Raises
        ------
        ValueError
            In one sentence: what is wrong with the file, a key (the nearest known one is offered) or a value.
        """
        return cls.from_values({"name": Path(path).stem, **read_toml(path, "case")}, Path(path).parent)

    @classmethod
    def from_values(cls, values: dict, folder: Path) -> "Case":
        """A case from plain values; relative file names are meant from a folder.

        Raises
        ------
        ValueError
            In one sentence: what is wrong with a key or a value.
        """
        case = validated(cls, values)
        parts = {"scene": case.scene, "flight": case.flight, "sensor": case.sensor}
        located = {name: part.located(folder) for name, part in parts.items()}
        return case.model_copy(update=located)


def find_case(name: str) -> Path:
    """A file as named, or else a packaged case of that name."""
    path = Path(name)
    packaged = _PACKAGED_CASES / f"{name}.toml"
    return packaged if not path.exists() and packaged.exists() else path


def packaged_case(name: str) -> Path | None:
    """The file of a packaged case (not of a study), if there is one of exactly that name."""
    for path in _PACKAGED_CASES.glob("*.toml"):
        if path.stem == name and "case" not in read_toml(path, "case"):  # a study names its base case
            return path
    return None


def read_toml(path: str | Path, name: str) -> dict:
    """Read a TOML file into plain values; ``name`` says what the file is in the error.

    Raises
    ------
    ValueError
        If the file cannot be read, is not UTF-8 or not TOML.
    """
    path = Path(path)
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8"))
    except OSError as error:
        raise ValueError(f"`{name}` must be a readable TOML file, got {path} ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"`{name}` must be UTF-8 text, got {path} with a byte that is not") from error
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"`{name}` must be valid TOML, got {path}: {error}") from error


def validated(model: type[Model], values: dict) -> Model:
    """Build a design from plain values; a fault is one ValueError with one sentence (see `describe`)."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ValueError(describe(error, model)) from error


def describe(error: ValidationError, model: type[BaseModel]) -> str:
    """First fault of a validation error as one sentence: key, requirement, what came, the nearest key."""
    fault = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in fault["loc"])
    if fault["type"] == "extra_forbidden":
        known = _fields_at(model, fault["loc"][:-1])
        near = difflib.get_close_matches(str(fault["loc"][-1]), known, n=1, cutoff=0.5)
        remedy = f"did you mean `{near[0]}`?" if near else f"known keys: {', '.join(sorted(known))}"
        return f"`{key}` must be a known key, got an unknown one ({remedy})"
    if fault["type"] == "missing":
        return f"`{key}` must be given, got only {', '.join(map(str, fault['input'])) or 'an empty table'}"
    message = fault["msg"].removeprefix("Value error, ")
    if fault["type"] == "value_error":
        tables = [str(part) for part in fault["loc"][:1] if _fields_at(model, fault["loc"][:1])]
        table = tables[0] if tables else ""
        known = message.startswith(f"`{table}.") or not message.startswith("`")
        return message if known or not table else f"`{table}.{message[1:]}"
    requirement = message.removeprefix("Input should be ")
    return f"`{key}` must be {requirement}, got {fault['input']!r}"


def _fields_at(model: type[BaseModel], path: tuple) -> list[str]:
    """Names a table of the case may hold."""
    for part in path:
        field = model.model_fields.get(str(part))
        if field is None or not (
            isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
        ):
            return []
        model = field.annotation
    return list(model.model_fields)
