"""The datasheet of a set, after Gebru et al., "Datasheets for datasets", Commun. ACM 64 (12), 86 (2021)."""

import pandas as pd

from glintrack.core.about import VERSION
from glintrack.dataset.plan import SPLITS, DatasetPlan, city_of
from glintrack.metrics import VISIBLE_FRACTION


def datasheet(plan: DatasetPlan, boxes: dict[str, pd.DataFrame]) -> str:
    """Markdown: what the set holds, how it was made, what it is for and what it is not.

    Parameters
    ----------
    plan
        Of the set.
    boxes
        Rows of boxes of each case.
    """
    return "\n".join(
        [
            "# Datasheet",
            "",
            _MOTIVATION,
            "## Composition",
            "",
            *_composition(plan, boxes),
            "",
            _LAYERS,
            "## Collection",
            "",
            f"Simulated by glintrack {VERSION}, key of the set `{plan.key}`. Every case lies in `cases/`;",
            "the same cases, seeds and version give the same bytes on the same machine and libraries.",
            "",
            _REST,
        ]
    )


def _composition(plan: DatasetPlan, boxes: dict[str, pd.DataFrame]) -> list[str]:
    lines = [
        "| split | cases | cities | frames | of each case | vehicles in frames | seen | moving | parked |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for split in SPLITS:
        names = [name for name in plan.cases if plan.split[name] == split]
        if not names:
            continue
        rows = pd.concat([boxes[name] for name in names], ignore_index=True)
        cities = sorted({city_of(plan.cases[name]) for name in names})
        seen = len(rows.query(f"visible_fraction >= {VISIBLE_FRACTION}"))
        flown = [plan.cases[name].flight.frames for name in names]
        each = str(flown[0]) if min(flown) == max(flown) else f"{min(flown)} to {max(flown)}"
        lines.append(
            f"| {split} | {len(names)} | {'; '.join(cities)} | {sum(flown)} | {each} | {len(rows)} | "
            f"{seen} | {len(rows.query('moving == 1'))} | {len(rows.query('parked == 1'))} |"
        )
    lines += ["", "Seen: at least a quarter of it, as docs/conventions.md of glintrack counts.", ""]
    classes = pd.concat(boxes.values(), ignore_index=True)["class"].value_counts().sort_index()
    return [*lines, "Classes: " + ", ".join(f"{name} {count}" for name, count in classes.items()) + "."]


_MOTIVATION = """## Motivation

Detectors and trackers of vehicles in wide-area imagery of a polarizing mosaic need frames whose truth
is known: where every vehicle is, which elements show it, and what light fell on them. No real set has
the last.
"""
_LAYERS = """- `raw/CASE/000001.png`: counts of every element, 16 bits, one band; calibrated, with noise.
- `shards/*.nc`: `light` (Stokes vectors at the superpixels without noise, blur or mosaic), `mask`
  (vehicle_id of every element), rectified `pan`, `stokes_radiance` and `dolp`, true and reported pose
  of every frame.
- `shards/*.boxes.csv`: each vehicle that a frame holds a part of, hidden ones and parked ones too: box
  in the raw (element centres at integers) and on the ground, class, speed, visible fraction.
  `vehicle_id` is the track's; parked from a million on.
- `shards/*.truth.csv`: all moving vehicles of the city, in frame or not, as `glintrack score` reads
  them.
- `coco/SPLIT.json`: those of which an element's middle is seen, with masks. `mot/SPLIT/CASE`: those of
  which anything is seen; only those that move and of which a quarter is seen count (flag 1).
- `shards/*.toml`, `SHA256SUMS`: hashes of all files.

Splits go by city: one network, mesh or embedded plan is in one split, wherever its windows lie.
"""
_REST = """## Uses

To train and compare detectors and trackers, and to learn what a mosaic hides. It shows no real place as
it is: buildings' heights, roofs, trees, parked vehicles and paints are drawn by rule, light between
surfaces is approximate, nothing is thermal, and there are no people. What is learnt on it must be
proved on real imagery before it is trusted there. The embedded cities of several seeds share streets
and traffic, and differ in houses, trees, parked vehicles and paints.

## Distribution and maintenance

Made by whoever ran the command; streets and footprints of OpenStreetMap are under the ODbL. A set is
made anew from its `cases/` with the version above; it is not changed in place.
"""
