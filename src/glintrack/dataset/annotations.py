"""Labels of a set as others read them: COCO for detectors, MOTChallenge for trackers, and its datasheet.

Pixels are elements of the raw. In COCO their edges are at integers, so that an element's middle lies at a
half; MOTChallenge counts pixels and frames from 1. The datasheet follows Gebru et al., "Datasheets for
datasets", Commun. ACM 64 (12), 86 (2021).
"""

import json
from pathlib import Path

import numpy as np
import pandas as pd

from glintrack.core.installation import VERSION, require_extra
from glintrack.dataset.plan import SPLITS, DatasetPlan, city_of
from glintrack.dataset.shards import ShardFiles
from glintrack.io.atomic import write_text
from glintrack.io.netcdf import read_dataset
from glintrack.io.tables import read_csv
from glintrack.metrics import VISIBLE_FRACTION
from glintrack.scene import VEHICLE_CLASSES

_MOT_CAR = 3


def write_annotations(folder: Path, plan: DatasetPlan) -> dict[str, pd.DataFrame]:
    """COCO files of each split and MOTChallenge's of each case, from the shards.

    Returns
    -------
    Rows of boxes of each case.

    Raises
    ------
    MissingExtraError
        Without pycocotools, which encodes the masks.
    """
    masks = require_extra("pycocotools.mask", "dataset", "write masks for COCO")
    tables = {name: boxes_of(folder, plan, name) for name in plan.cases}
    (folder / "coco").mkdir(exist_ok=True)
    for split in SPLITS:
        names = [name for name in plan.cases if plan.split[name] == split]
        if names:
            text = json.dumps(_coco(folder, plan, names, tables, masks), sort_keys=True)
            write_text(folder / "coco" / f"{split}.json", text)
    for name in plan.cases:
        _write_mot(folder, plan, name, tables[name])
    return tables


def boxes_of(folder: Path, plan: DatasetPlan, name: str) -> pd.DataFrame:
    """Rows of boxes of one case, frame by frame."""
    return _joined(folder / ShardFiles(shard).boxes for shard in plan.shards(name))


def truth_of(folder: Path, plan: DatasetPlan, name: str) -> pd.DataFrame:
    """Rows of the moving vehicles of one case."""
    return _joined(folder / ShardFiles(shard).truth for shard in plan.shards(name))


def _joined(paths) -> pd.DataFrame:
    return pd.concat([read_csv(path, "shard") for path in paths], ignore_index=True)


def _coco(folder: Path, plan: DatasetPlan, names: list[str], tables: dict[str, pd.DataFrame], masks) -> dict:
    images, annotations = [], []
    for name in names:
        case = plan.cases[name]
        for shard in plan.shards(name):
            files = ShardFiles(shard)
            data = read_dataset(folder / files.data, "shard")
            for place, k in enumerate(shard.frames):
                image = len(images) + 1
                images.append(
                    {
                        "id": image,
                        "file_name": files.raw(k),
                        "width": case.sensor.columns,
                        "height": case.sensor.rows,
                        "case": name,
                        "frame": k,
                        "time_s": round(float(data["time_s"][place]), 6),
                    }
                )
                mine = tables[name].query(f"frame == {k}")
                mask = data["mask"].values[place]
                annotations += _of_frame(mine, mask, image, len(annotations), masks)
    categories = [
        {"id": k, "name": vehicle, "supercategory": "vehicle"}
        for k, vehicle in enumerate(VEHICLE_CLASSES, start=1)
    ]
    about = {"description": "glintrack: simulated raw mosaics with truth", "version": plan.key}
    return {"info": about, "images": images, "categories": categories, "annotations": annotations}


def _of_frame(boxes: pd.DataFrame, mask: np.ndarray, image: int, before: int, masks) -> list[dict]:
    """Annotations of the vehicles that at least one element's middle shows."""
    category = {vehicle: k for k, vehicle in enumerate(VEHICLE_CLASSES, start=1)}
    found = []
    for row in boxes.to_dict("records"):
        shown = mask == row["vehicle_id"]
        if not shown.any():
            continue
        encoded = masks.encode(np.asfortranarray(shown.astype(np.uint8)))
        x, y = row["x0_px"] + 0.5, row["y0_px"] + 0.5
        found.append(
            {
                "id": before + len(found) + 1,
                "image_id": image,
                "category_id": category[row["class"]],
                "bbox": [
                    round(v, 3) for v in (x, y, row["x1_px"] - row["x0_px"], row["y1_px"] - row["y0_px"])
                ],
                "area": int(shown.sum()),
                "segmentation": {"size": encoded["size"], "counts": encoded["counts"].decode("ascii")},
                "iscrowd": 0,
                "track_id": int(row["vehicle_id"]),
                "visible_fraction": float(row["visible_fraction"]),
                "speed_m_s": float(row["speed_m_s"]),
                "moving": int(row["moving"]),
                "parked": int(row["parked"]),
            }
        )
    return found


def _write_mot(folder: Path, plan: DatasetPlan, name: str, boxes: pd.DataFrame) -> None:
    """``gt.txt`` and ``seqinfo.ini``; what stands or can hardly be seen does not count (flag 0)."""
    case, place = plan.cases[name], folder / "mot" / plan.split[name] / name
    (place / "gt").mkdir(parents=True, exist_ok=True)
    lines = []
    for row in boxes.query("visible_fraction > 0").to_dict("records"):
        counts = int(row["moving"] == 1 and row["visible_fraction"] >= VISIBLE_FRACTION)
        box = (
            row["x0_px"] + 1.5, row["y0_px"] + 1.5, row["x1_px"] - row["x0_px"], row["y1_px"] - row["y0_px"],
        )  # fmt: skip
        of = ",".join(f"{v:.2f}" for v in box)
        head = f"{int(row['frame']) + 1},{int(row['vehicle_id']) + 1}"
        lines.append(f"{head},{of},{counts},{_MOT_CAR},{row['visible_fraction']:.3f}\n")
    write_text(place / "gt" / "gt.txt", "".join(lines))
    write_text(
        place / "seqinfo.ini",
        f"[Sequence]\nname={name}\nimDir=../../../raw/{name}\nframeRate={case.flight.rate_hz:g}\n"
        f"seqLength={case.flight.frames}\nimWidth={case.sensor.columns}\nimHeight={case.sensor.rows}\n"
        "imExt=.png\n",
    )


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
