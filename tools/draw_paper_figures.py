"""Figures 12 and 13 of Presnar et al. (2010), drawn from flights over the embedded city.

``python tools/draw_paper_figures.py docs/gallery [--frames 30] [--oversampling 2]`` writes ``figure12.jpg``
(nadir, pan, no trees, the whole spectrometer: the pixels queried at one epoch, and the labelled tracks with
their one-second predictions) and ``figure13.jpg`` (50° off nadir toward the sun: DoLP with its tracks, and
DoLP boosted by 5 and thresholded, with its). Tracks are those of the packaged case's tracker; boosted DoLP is
searched by the detector `median-motion`, which alone uses them.
"""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.loop import simulate
from glintrack.results.epoch import Epoch
from glintrack.results.figures import MARKS
from glintrack.results.figures.tracks import show_pan, show_tracks
from glintrack.track import TrackDesign

SLANT_RANGE_M = 3000.0
UNLIMITED = 10_000
BOOST, THRESHOLD = 5.0, 0.25  # the paper boosts by 5 and does not say what the threshold is
VIEW_M = (-330.0, 330.0, -210.0, 210.0)
JPEG_QUALITY = 72


def simulate_flight(
    args: argparse.Namespace, off_nadir_deg: float, trees: bool, trackers: Mapping[str, TrackDesign]
) -> tuple[xr.DataTree, dict[str, Epoch]]:
    """Simulate a case; return its result and each tracker's last epoch."""
    case = Case.from_toml(find_case("quickstart")).replace(
        {
            "scene.trees": trees,
            "flight.off_nadir_deg": off_nadir_deg,
            "flight.altitude_m": SLANT_RANGE_M * float(np.cos(np.deg2rad(off_nadir_deg))),
            "flight.frames": args.frames,
            "sensor.oversampling": args.oversampling,
        }
    )
    last: dict[str, Epoch] = {}

    def callback(epoch: Epoch) -> None:
        last[epoch.channel] = epoch
        print(f"\r{epoch.index + 1}/{args.frames} ", end="", file=sys.stderr, flush=True)

    tree = simulate(case, callback, trackers=trackers)
    if int(tree.attrs["interrupted"]):
        raise KeyboardInterrupt
    return tree, last


def describe_epoch(epoch: Epoch) -> str:
    """Scores of an epoch in words."""
    score = epoch.score
    return (
        f"{int(score.valid.sum())} of {int(score.should.sum())} moving vehicles tracked, "
        f"{int(score.false.sum())} false tracks"
    )


def show_queries(ax: Axes, epoch: Epoch) -> None:
    """Mirrors that served, in the pan frame."""
    show_pan(ax, epoch.image)
    on = epoch.served.is_served
    place = np.array([[q.east_m, q.north_m] for q in epoch.served.queries]).reshape(-1, 2)
    ground = np.array([q.track_id < 0 for q in epoch.served.queries], bool)
    for chosen, colour in ((on & ~ground, MARKS["true"]), (on & ground, MARKS["missed"])):
        ax.scatter(*place[chosen].T, s=12, marker="s", facecolors="none", edgecolors=colour, linewidths=0.7)
    ax.set_title(
        f"HSI pixels queried: {int((on & ~ground).sum())} of tracks, {int((on & ground).sum())} of the road",
        fontsize=8,
    )


def show_tracked(ax: Axes, tree: xr.DataTree, epoch: Epoch) -> None:
    """Labelled tracks and their one-second predictions over what is drawn."""
    show_tracks(ax, tree[f"{epoch.channel}/tracks"].to_dataset(), epoch.time_s, label=True)
    ax.set_title(describe_epoch(epoch), fontsize=8)


def show_degree(ax: Axes, degree: np.ndarray, highest: float) -> None:
    """DoLP on the ground grid, black to white as the paper draws it."""
    shown = ax.imshow(degree, cmap="gray", vmin=0, vmax=highest, extent=VIEW_M, interpolation="nearest")
    ax.figure.colorbar(shown, ax=ax, shrink=0.7, label="DoLP" if highest < 1 else f"{BOOST:g} × DoLP")
    ax.set(xlabel="east [m]", ylabel="north [m]", facecolor="#35506a")


def save(figure: plt.Figure, path: Path) -> None:
    """As JPEG."""
    options = {"quality": JPEG_QUALITY, "optimize": True}
    figure.savefig(path, bbox_inches="tight", pad_inches=0.05, pil_kwargs=options)
    plt.close(figure)
    print(f"wrote {path} ({path.stat().st_size // 1000} kB)")


def panels() -> tuple[plt.Figure, list[Axes]]:
    """One above the other, as wide as the area is."""
    figure, axes = plt.subplots(2, 1, figsize=(7.0, 7.6), dpi=125, layout="constrained")
    return figure, list(axes)


def draw_figure_12(args: argparse.Namespace) -> None:
    """Nadir pan."""
    packaged = Case.from_toml(find_case("quickstart")).track
    tree, last = simulate_flight(args, 0.0, False, {"pan": packaged.replace({"query.budget": UNLIMITED})})
    figure, (above, below) = panels()
    show_queries(above, last["pan"])
    show_pan(below, last["pan"].image)
    show_tracked(below, tree, last["pan"])
    for ax in (above, below):
        ax.set(xlim=VIEW_M[:2], ylim=VIEW_M[2:])
    save(figure, args.out / "figure12.jpg")


def draw_figure_13(args: argparse.Namespace) -> None:
    """Oblique DoLP, plain and boosted."""
    plain = Case.from_toml(find_case("quickstart")).track.replace({"detect.channel": "dolp"})
    boosted = TrackDesign().replace(
        {
            "detect.detector": "median-motion",
            "detect.channel": "dolp",
            "detect.dolp_boost": BOOST,
            "detect.dolp_threshold": THRESHOLD,
        }
    )
    tree, last = simulate_flight(args, 50.0, True, {"plain": plain, "boosted": boosted})
    figure, (above, below) = panels()
    show_degree(above, last["plain"].image["dolp"].values, 0.5)
    degree = np.clip(BOOST * last["boosted"].image["dolp"].values, 0, 1)
    show_degree(below, np.where(degree < THRESHOLD, 0, degree), 1.0)
    for ax, name in ((above, "plain"), (below, "boosted")):
        show_tracked(ax, tree, last[name])
        ax.set(xlim=VIEW_M[:2], ylim=VIEW_M[2:])
    save(figure, args.out / "figure13.jpg")


def main() -> None:
    """Fly and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder of the pictures")
    parser.add_argument("--frames", type=int, default=30, help="at 2 Hz; the last one is drawn")
    parser.add_argument("--oversampling", type=int, default=2, help="rays along each side of an element")
    args = parser.parse_args()
    plt.switch_backend("agg")
    draw_figure_12(args)
    draw_figure_13(args)


if __name__ == "__main__":
    main()
