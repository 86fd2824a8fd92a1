"""Boxes and masks of a set as others read them: COCO for detectors, MOTChallenge for trackers.

Pixels are elements of the raw. In COCO their edges are at integers, so that an element's middle lies at a
half; MOTChallenge counts pixels and frames from 1.
"""

import json
from pathlib import Path

import numpy as np
import pandas as pd

from glintrack.core.extras import require_extra
from glintrack.dataset.plan import SPLITS, DatasetPlan
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
