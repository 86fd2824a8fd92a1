"""The file of a study: a base case, axes named by the case's own keys, a design and its constraints."""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from glintrack.case.packaged import PACKAGED_CASES
from glintrack.core.designs import Design, validated
from glintrack.io.toml import read_toml

SAMPLED = ("latin-hypercube", "sobol", "saltelli")
POWERS_OF_TWO = ("sobol", "saltelli")
MOST_CASES = 100_000
_OF_CASES = {"like", "channels", "scene", "atmosphere", "flight", "sensor", "track"}

_Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]


class Constraints(Design):
    """What follows from other keys in every case; the ``[constraints]`` table of a study."""

    slant_range_m: float | None = Field(
        default=None, ge=200, le=50000, description="Altitude follows the off-nadir angle at this slant range"
    )
    duration_s: float | None = Field(
        default=None, gt=0, le=1e5, description="Frames follow the frame rate, for flights of one length"
    )
    rate_is_clock: bool = Field(default=False, description="Every frame the clock gives is taken")
    constant_field: bool = Field(
        default=False,
        description="Rows and columns follow pitch and focal length, for one field, unless an axis sets them",
    )


class Contrast(Design):
    """Two designs or channels that a report holds against each other, at each point of all other axes."""

    label: str = Field(min_length=1, max_length=80, description="What the difference is called")
    of: dict[str, Any] = Field(description="`channel` and values of axes")
    against: dict[str, Any] = Field(description="The same keys with the values that are taken away")

    @field_validator("of", "against")
    @classmethod
    def _plain_values(cls, side: dict[str, Any]) -> dict[str, Any]:
        for name, level in flat(side).items():
            if not isinstance(level, (bool, int, float, str)):
                raise ValueError(f"`{name}` must be one value of its axis, got {level!r:.60}")
        return side

    @property
    def of_levels(self) -> dict[str, Any]:
        """Dotted keys of the side that counts."""
        return flat(self.of)

    @property
    def against_levels(self) -> dict[str, Any]:
        """Dotted keys of the side that is taken away."""
        return flat(self.against)


class StudyDesign(Design):
    """A trade study: which cases to fly, and how; what ``glintrack study`` reads."""

    name: str = Field(default="study", min_length=1, max_length=80)
    """What the study's folder and pictures are called by."""
    case: str = Field(default="quickstart", description="Base case: a file beside the study, or packaged")
    design: Literal["one-at-a-time", "factorial", "latin-hypercube", "sobol", "saltelli", "list"] = Field(
        default="one-at-a-time", description="How the axes are combined"
    )
    samples: int | None = Field(
        default=None, ge=1, le=MOST_CASES, description="Points of a sampled design; Sobol's: a power of two"
    )
    sampling_seed: _Seed = Field(default=0, description="Of the scrambled or shuffled points")
    seeds: tuple[_Seed, ...] = Field(default=(), description="Replicates that differ in the case's seed only")
    replicates: tuple[dict[str, Any], ...] = Field(
        default=(), description="Replicates as tables of keys, e.g. seed and flight.start_s"
    )
    retries: int = Field(default=1, ge=0, le=10, description="How often a failed case is tried again")
    base: dict[str, Any] = Field(default={}, description="Keys that differ from the base case throughout")
    axes: dict[str, Any] = Field(default={}, description="Keys with their values, or a range")
    cases: tuple[dict[str, Any], ...] = Field(default=(), description="The cases of design = 'list'")
    constraints: Constraints = Constraints()
    contrasts: tuple[Contrast, ...] = Field(default=(), description="What the report holds against what")
    ranked_under: tuple[str, ...] = Field(
        default=(), description="Axes under whose values the report ranks the designs, as detector or city"
    )

    @field_validator("replicates", mode="before")
    @classmethod
    def _tables(cls, given: Any) -> Any:
        if isinstance(given, int):
            raise ValueError(
                f"`replicates` must be a list of tables, as [{{ seed = 1, scene.seed = 1 }}, …], got {given} "
                "(`seeds = [1, 2]` for replicates that differ in noise alone)"
            )
        return given

    @model_validator(mode="after")
    def _what_the_design_needs(self) -> Self:
        if (self.design == "list") != bool(self.cases) or (self.design == "list" and self.axes):
            raise ValueError(
                "`cases` must be given with design = 'list' and only then, and `axes` with every other, got "
                f"design = {self.design!r}, {len(self.cases)} cases and {len(self.axes)} axes"
            )
        if self.design != "list" and not self.axes:
            raise ValueError(f"`axes` must name at least one key, got none with design = {self.design!r}")
        if (self.design in SAMPLED) != (self.samples is not None):
            raise ValueError(
                f"`samples` must be given with {', '.join(SAMPLED)} and only then, got "
                f"{self.samples} with design = {self.design!r}"
            )
        if self.design in POWERS_OF_TWO and self.samples and self.samples & (self.samples - 1):
            raise ValueError(
                f"`samples` must be a power of two for Sobol's points, got {self.samples} "
                f"(use {1 << (self.samples - 1).bit_length()})"
            )
        if self.seeds and self.replicates:
            raise ValueError("`seeds` must not be given together with `replicates`, got both")
        return self

    @property
    def replicate_keys(self) -> tuple[dict[str, Any], ...]:
        """Keys of each replicate, dotted; one empty replicate if none is asked for."""
        if self.seeds:
            return tuple({"seed": seed} for seed in self.seeds)
        return tuple(flat(table) for table in self.replicates) or ({},)


def read_study(path: str | Path) -> StudyDesign:
    """Read the file of a study.

    Raises
    ------
    ValueError
        In one sentence: what is wrong with the file, a key or a value.
    """
    values = read_toml(path, "study")
    if _OF_CASES & set(values) and not {"axes", "case"} & set(values):
        named = Path(path).stem if Path(path).parent == PACKAGED_CASES else path
        raise ValueError(
            f"`study` must be a study, got the case {named} (glintrack run {named} flies it; a study names "
            "it as its `case` and says under [axes] what varies)"
        )
    return validated(StudyDesign, {"name": Path(path).stem, **values})


def flat(table: dict[str, Any], stem: str = "") -> dict[str, Any]:
    """Nested tables as one with dotted keys; a table that says ``from`` and ``to`` is a value, a range."""
    out: dict[str, Any] = {}
    for key, value in table.items():
        name = f"{stem}{key}"
        if isinstance(value, dict) and not {"from", "to"} & set(value):
            out |= flat(value, f"{name}.")
        else:
            out[name] = value
    return out
