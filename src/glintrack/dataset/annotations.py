"""Labels of a set in standard formats: COCO for detectors, MOTChallenge for trackers, and its datasheet.

Pixels are elements of the raw. In COCO their edges are at integers and their centres at halves; MOTChallenge
counts pixels and frames from 1. The datasheet follows Gebru et al., "Datasheets for
datasets", Commun. ACM 64 (12), 86 (2021).
"""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from glintrack.core.installation import VERSION, data_file, require_extra
from glintrack.dataset.plan import SPLITS, DatasetPlan, city_of
from glintrack.io.atomic import write_text
from glintrack.io.netcdf import read_dataset
from glintrack.io.tables import read_csv
from glintrack.metrics import VISIBLE_FRACTION
from glintrack.scene import VEHICLE_CLASSES

_MOT_CAR, _MOT_MOTORCYCLE = 3, 5


def write_annotations(folder: Path, plan: DatasetPlan) -> dict[str, pd.DataFrame]:
    """Write COCO files of each split and MOTChallenge's of each case, from the shards.

    Returns
    -------
    Rows of boxes of each case.

    Raises
    ------
    MissingExtraError
        Without pycocotools, which encodes the masks.
    """
    masks = require_extra("pycocotools.mask", "dataset", "write masks for COCO")
    tables = {name: read_rows(folder, plan, name, "boxes.csv") for name in plan.cases}
    (folder / "coco").mkdir(exist_ok=True)
    for split in dict.fromkeys(plan.split.values()):
        text = json.dumps(_coco(folder, plan, plan.names(split), tables, masks), sort_keys=True)
        write_text(folder / "coco" / f"{split}.json", text)
    for name in plan.cases:
        _write_mot(folder, plan, name, tables[name])
    return tables


def read_rows(folder: Path, plan: DatasetPlan, name: str, ending: str) -> pd.DataFrame:
    """Read the rows of ``boxes.csv`` or ``truth.csv`` of one case, frame by frame."""
    tables = [read_csv(folder / shard.file(ending), "shard") for shard in plan.shards(name)]
    return pd.concat(tables, ignore_index=True)


def _coco(folder: Path, plan: DatasetPlan, names: list[str], tables: dict[str, pd.DataFrame], masks) -> dict:
    images, annotations = [], []
    for name in names:
        case = plan.cases[name]
        for shard in plan.shards(name):
            data = read_dataset(folder / shard.file("nc"), "shard")
            for place, k in enumerate(shard.frames):
                images.append(
                    {
                        "id": len(images) + 1,
                        "file_name": shard.raw(k),
                        "width": case.sensor.columns,
                        "height": case.sensor.rows,
                        "case": name,
                        "frame": k,
                        "time_s": round(float(data["time_s"][place]), 6),
                    }
                )
                mask = data["mask"].values[place]
                for row in tables[name].query(f"frame == {k}").to_dict("records"):
                    shown = mask == row["vehicle_id"]
                    if shown.any():
                        encoded = masks.encode(np.asfortranarray(shown.astype(np.uint8)))
                        ids = {"id": len(annotations) + 1, "image_id": len(images)}
                        annotations.append(ids | _annotation(row, int(shown.sum()), encoded))
    categories = [
        {"id": k, "name": vehicle, "supercategory": "vehicle"}
        for k, vehicle in enumerate(VEHICLE_CLASSES, start=1)
    ]
    about = {"description": "glintrack: simulated raw mosaics with truth", "version": plan.key}
    return {"info": about, "images": images, "categories": categories, "annotations": annotations}


def _annotation(row: Mapping, area: int, encoded: dict) -> dict:
    """Annotation of a vehicle with an area of some elements."""
    width, height = row["x1_px"] - row["x0_px"], row["y1_px"] - row["y0_px"]
    return {
        "category_id": VEHICLE_CLASSES.index(row["class"]) + 1,
        "bbox": [round(v, 3) for v in (row["x0_px"] + 0.5, row["y0_px"] + 0.5, width, height)],
        "area": area,
        "segmentation": {"size": encoded["size"], "counts": encoded["counts"].decode("ascii")},
        "iscrowd": 0,
        "track_id": int(row["vehicle_id"]),
        "visible_fraction": float(row["visible_fraction"]),
        "speed_m_s": float(row["speed_m_s"]),
        "moving": int(row["moving"]),
        "parked": int(row["parked"]),
    }


def _write_mot(folder: Path, plan: DatasetPlan, name: str, boxes: pd.DataFrame) -> None:
    """Write ``gt.txt`` and ``seqinfo.ini``; stationary and hardly visible vehicles do not count (flag 0)."""
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
        kind = _MOT_MOTORCYCLE if row["class"] == "motorcycle" else _MOT_CAR
        lines.append(f"{head},{of},{counts},{kind},{row['visible_fraction']:.3f}\n")
    write_text(place / "gt" / "gt.txt", "".join(lines))
    write_text(
        place / "seqinfo.ini",
        f"[Sequence]\nname={name}\nimDir=../../../raw/{name}\nframeRate={case.flight.rate_hz:g}\n"
        f"seqLength={case.flight.frames}\nimWidth={case.sensor.columns}\nimHeight={case.sensor.rows}\n"
        "imExt=.png\n",
    )


def datasheet(plan: DatasetPlan, boxes: dict[str, pd.DataFrame]) -> str:
    """Datasheet in Markdown: composition, origin, uses and limitations of a set.

    Parameters
    ----------
    plan
        Plan of the set.
    boxes
        Rows of boxes of each case.
    """
    template = data_file("datasheet.md").read_text(encoding="utf-8")
    return template.format(composition=_composition(plan, boxes), version=VERSION, key=plan.key)


def _composition(plan: DatasetPlan, boxes: dict[str, pd.DataFrame]) -> str:
    lines = [
        "| split | cases | cities | frames | of each case | vehicles in frames | seen | moving | parked |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for split in (one for one in SPLITS if one in plan.split.values()):
        names = plan.names(split)
        rows = pd.concat([boxes[name] for name in names], ignore_index=True)
        cities = sorted({city_of(plan.cases[name]) for name in names})
        seen = len(rows.query(f"visible_fraction >= {VISIBLE_FRACTION}"))
        frames = [plan.cases[name].flight.frames for name in names]
        each = str(frames[0]) if min(frames) == max(frames) else f"{min(frames)} to {max(frames)}"
        lines.append(
            f"| {split} | {len(names)} | {'; '.join(cities)} | {sum(frames)} | {each} | {len(rows)} | "
            f"{seen} | {len(rows.query('moving == 1'))} | {len(rows.query('parked == 1'))} |"
        )
    lines += ["", "Seen: at least a quarter of it, as docs/conventions.md of glintrack counts.", ""]
    classes = pd.concat(boxes.values(), ignore_index=True)["class"].value_counts().sort_index()
    return "\n".join([*lines, "Classes: " + ", ".join(f"{name} {n}" for name, n in classes.items()) + "."])
