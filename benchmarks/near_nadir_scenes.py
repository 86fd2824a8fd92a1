"""Near-nadir frames with truth for near_nadir.py: painted without a renderer, or flown and made worse.

A painted scene has noise with edges for ground, a turned grid of streets, a fast road, a roundabout, roofs
and crowns that parallax moves, parked cars, and moving boxes of either contrast with shadows. Every frame,
painted or flown, is displaced by a fraction of a pixel as a whole and locally, its gain drifts, it is
blurred, noisy and quantized.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import rasterio
from scipy import ndimage

FINE = 3  # parts of a pixel's side that are painted
RATE_HZ = 1.25
MOVING_M_S = 1.0
EDGE_M = 4.0  # vehicles nearer to the frame's edge are not asked for


@dataclass(frozen=True)
class Wear:
    """What happens to frames between the lens and the user.

    Parameters
    ----------
    shift_px, warp_px
        Registration error: of the whole frame, and locally over some 60 m, RMS. [pixel]
    gain, offset
        Step of the random walk of the frames' gain [1] and of their offset [share of the mean].
    blur_px
        Standard deviation of a Gaussian. [pixel]
    noise
        Of a pixel, of the mean radiance. [1]
    bits
        Of the file; 0 is no data.
    """

    shift_px: float = 0.3
    warp_px: float = 0.2
    gain: float = 0.02
    offset: float = 0.01
    blur_px: float = 0.4
    noise: float = 0.025
    bits: int = 8


@dataclass(frozen=True)
class Sequence:
    """Frames on one grid and the vehicles in them.

    Parameters
    ----------
    name
        Of the scene.
    times_s
        Of the frames. [s]
    frames
        Counts, 8- or 16-bit.
    gsd_m
        Side of a pixel; the north-west corner lies at (0, 0). [m]
    truth
        time_s, vehicle_id, east_m, north_m, east_speed_m_s, north_speed_m_s, length_m, visible_fraction.
    """

    name: str
    times_s: np.ndarray
    frames: np.ndarray
    gsd_m: float
    truth: pd.DataFrame


def worn(clean: np.ndarray, gsd_m: float, wear: Wear, rng: np.random.Generator) -> np.ndarray:
    """Frames as a user has them: displaced, drifting, blurred, noisy, quantized."""
    count, height, width = clean.shape
    missing = ~np.isfinite(clean)
    low, high = np.nanquantile(clean, [0.005, 0.995])
    mean = np.nanmean(clean)
    clean = np.where(missing, mean, clean)
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    gain = 1 + np.cumsum(rng.normal(0, wear.gain, count))
    offset = mean * np.cumsum(rng.normal(0, wear.offset, count))
    out = np.empty(clean.shape, np.uint8 if wear.bits <= 8 else np.uint16)
    most = 2**wear.bits - 1
    for k in range(count):
        frame = ndimage.gaussian_filter(clean[k].astype(np.float32), wear.blur_px)
        shift = rng.normal(0, wear.shift_px / np.sqrt(2), 2)
        local = ndimage.gaussian_filter(rng.normal(size=(2, height, width)), (0, 30 / gsd_m, 30 / gsd_m))
        local *= wear.warp_px / np.sqrt(2) / max(local.std(), 1e-12)
        frame = ndimage.map_coordinates(
            frame, [rows + shift[0] + local[0], columns + shift[1] + local[1]], order=3, mode="nearest"
        )
        frame = gain[k] * frame + offset[k] + rng.normal(0, wear.noise * mean, frame.shape)
        counts = (frame - low) / (high - low) * 0.8 * most + 0.1 * most
        out[k] = np.where(missing[k], 0, np.clip(np.rint(counts), 1, most))
    return out


def flown(folder: Path, factor: int, wear: Wear, seed: int, count: int = 16) -> Sequence:
    """A flight's kept frames and truth, box-averaged by a factor and worn."""
    files = sorted((folder / "frames").glob("pan_*.tif"))[:count]
    clean, times = [], []
    for file in files:
        with rasterio.open(file) as raster:
            clean.append(raster.read(1))
            gsd = raster.transform.a
            tags = raster.tags()
        times.append(float(tags["time_s"]) if "time_s" in tags else float(file.stem.split("_")[1][:-1]))
    stack = np.stack(clean)
    height, width = (n // factor * factor for n in stack.shape[1:])
    west, north = -0.5 * gsd * stack.shape[2], 0.5 * gsd * stack.shape[1]  # the truth counts from the middle
    stack = stack[:, :height, :width].reshape(len(stack), height // factor, factor, width // factor, factor)
    truth = pd.read_csv(folder / "truth.csv")
    truth = truth[truth["time_s"] < times[-1] + 1e-6]
    truth = truth.assign(east_m=truth["east_m"] - west, north_m=truth["north_m"] - north)
    seen = worn(stack.mean(axis=(2, 4)), gsd * factor, wear, np.random.default_rng(seed))
    return Sequence(f"{folder.name} {gsd * factor:g} m", np.array(times), seen, gsd * factor, truth)


@dataclass(frozen=True)
class _Lane:
    """A line or circle that vehicles follow: start, direction, length; or centre and radius."""

    start: np.ndarray
    heading: float
    length: float
    speed: float
    radius: float = 0.0
    red: tuple[float, float] = (np.inf, 0.0)  # place of a stop line and until when it holds

    def at(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places and headings (mathematical) after a way."""
        if self.radius:
            angle = self.heading + s / self.radius
            return (
                self.start + self.radius * np.stack([np.cos(angle), np.sin(angle)], -1),
                angle + np.pi / 2,
            )
        unit = np.array([np.cos(self.heading), np.sin(self.heading)])
        return self.start + s[:, None] * unit, np.full(len(s), self.heading)


def _drive(lane: _Lane, times: np.ndarray, headway_m: float, rng) -> list[tuple[np.ndarray, np.ndarray]]:
    """Places and speeds along a lane at each time, by the intelligent driver model."""
    gaps = rng.exponential(headway_m, 200) + 7.0
    place = -120.0 + np.cumsum(gaps)
    place = place[place < lane.length][::-1].copy()
    speed = lane.speed * rng.uniform(0.7, 1.1, len(place))
    wish = lane.speed * rng.uniform(0.8, 1.25, len(place))
    out, now = [], -6.0
    for t in times:
        while now < t:
            gap = np.r_[1e3, place[:-1] - place[1:] - 5.0] if len(place) else np.empty(0)
            closing = np.r_[0.0, speed[1:] - speed[:-1]] if len(place) else np.empty(0)
            if now < lane.red[1]:
                to_line = lane.red[0] - place
                held = (to_line > 0) & (to_line < gap)
                gap, closing = np.where(held, to_line, gap), np.where(held, speed, closing)
            wanted = 2 + np.maximum(0, speed * 1.1 + speed * closing / 4.9)
            pull = 2 * (1 - (speed / wish) ** 4 - (wanted / np.maximum(gap, 0.3)) ** 2)
            speed = np.clip(speed + np.clip(pull, -6, 2) * 0.1, 0, None)
            place = place + 0.1 * speed
            now += 0.1
        out.append((place.copy(), speed.copy()))
    return out


class _Town:
    """Everything that stands, painted once; and the lanes."""

    def __init__(self, size_m: float, gsd_m: float, rng: np.random.Generator, tall: float):
        self.cell = gsd_m / FINE
        n = round(size_m / self.cell)
        self.n, self.rng = n, rng
        x = self.cell * (np.arange(n) + 0.5)
        self.x, self.y = np.meshgrid(x, x[::-1] - size_m)  # north falls with the row, 0 at the top
        turn = rng.uniform(0, np.pi / 2)
        self.turn, centre = turn, np.array([size_m / 2, -size_m / 2])
        dx, dy = self.x - centre[0], self.y - centre[1]
        u, v = dx * np.cos(turn) + dy * np.sin(turn), dy * np.cos(turn) - dx * np.sin(turn)
        ground = np.full((n, n), 0.22)
        for scale, part in ((40, 0.05), (8, 0.035), (2, 0.025), (0.7, 0.02)):
            grain = ndimage.gaussian_filter(rng.normal(size=(n, n)).astype(np.float32), scale / self.cell)
            ground += part * grain / grain.std()
        plots = ndimage.zoom(rng.random((n // 60 + 2,) * 2), n / (n // 60 + 1), order=0)[:n, :n]
        ground += 0.08 * (plots - 0.5)  # fields with sharp borders
        self.lanes: list[tuple[_Lane, float]] = []
        along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
        half = 0.72 * size_m
        offsets = np.arange(-half, half, rng.uniform(80, 120)) + rng.uniform(0, 40)
        roads = [(0, o, 4.0, rng.uniform(7, 14), 120.0) for o in offsets]
        roads += [(1, o, 4.0, rng.uniform(7, 14), 120.0) for o in offsets[::2] + 30]
        roads.append((0, rng.uniform(-60, 60), 11.0, rng.uniform(20, 32), 100.0))  # a fast one
        for axis, o, wide, speed, headway in roads:
            d, w = (v - o, u) if axis == 0 else (u - o, v)
            asphalt = 0.13 + 0.02 * rng.random()
            on = np.abs(d) < wide
            ground = np.where(np.abs(d) < wide + 2.0, 0.27 + 0.03 * rng.random(), ground)
            ground = np.where(on, asphalt + 0.25 * (ground - ground.mean()) * 0.3, ground)
            ground = np.where((np.abs(d) < 0.12) & (np.mod(w, 9) < 4), 0.45, ground)
            direction, normal = (along, across) if axis == 0 else (across, along)
            for side in (-1, 1):
                for lane in np.arange(2.0, wide - 1.0, 3.4):
                    heading = np.arctan2(*(direction * -side)[::-1])
                    start = centre + normal * o + normal * side * lane + direction * side * half
                    red = (
                        (half + rng.uniform(-80, 80), rng.uniform(-5, 25))
                        if wide < 6 and rng.random() < 0.4
                        else (np.inf, 0.0)
                    )
                    self.lanes.append((_Lane(start, heading, 2 * half, speed, 0.0, red), headway))
        ring, radius = centre + rng.uniform(-0.25, 0.25, 2) * size_m, rng.uniform(30, 60)
        off = np.abs(np.hypot(self.x - ring[0], self.y - ring[1]) - radius)
        ground = np.where(off < 5, 0.28, ground)
        ground = np.where(off < 4, 0.14, ground)
        self.lanes.append((_Lane(ring, 0.0, 1.6 * np.pi * radius, 9.0, radius), 30.0))
        self.asphalt = ground < 0.2
        self.ground = ndimage.gaussian_filter(ground, 0.3 / self.cell)
        self._parked(roads, along, across, centre, half)
        self._stand(tall)

    def _parked(self, roads, along, across, centre, half):
        for axis, o, wide, *_ in roads:
            direction, normal = (along, across) if axis == 0 else (across, along)
            for s in np.arange(-half, half, 7.0):
                if wide < 6 and self.rng.random() < 0.3:
                    at = centre + normal * (o + self.rng.choice([-1, 1]) * (wide + 0.9)) + direction * s
                    self.ground = self.paint(
                        self.ground, at, np.arctan2(*direction[::-1]), (4.5, 1.8), _body(self.rng)
                    )

    def _stand(self, tall: float):
        """Roofs and crowns off the roads: centre, half sizes, height, brightness."""
        self.tops = []
        wide = ndimage.binary_dilation(self.asphalt[::8, ::8], iterations=max(1, round(9 / (8 * self.cell))))
        for _ in range(round(4e-3 * (self.n * self.cell) ** 2)):
            row, column = self.rng.integers(0, self.n, 2)
            crown = self.rng.random() < 0.6
            if wide[row // 8, column // 8] and not (crown and self.rng.random() < 0.3):
                continue
            height = self.rng.uniform(5, 12) if crown else tall * self.rng.uniform(0.4, 1.6)
            half = self.rng.uniform(1.5, 4, 1).repeat(2) if crown else self.rng.uniform(4, 10, 2)
            bright = self.rng.uniform(0.05, 0.15) if crown else self.rng.uniform(0.08, 0.5)
            at = (self.cell * column, -self.cell * row)
            self.tops.append((crown, at, half, height, bright, self.rng.integers(1 << 30)))

    def paint(self, image, at, heading, size, value, share=1.0):
        """A turned box painted over a copy's place; in place for speed."""
        length, width = size
        reach = int(np.ceil(0.5 * np.hypot(length, width) / self.cell)) + 2
        column, row = int(at[0] / self.cell), int(-at[1] / self.cell)
        r0, r1, c0, c1 = (
            max(row - reach, 0),
            min(row + reach, self.n),
            max(column - reach, 0),
            min(column + reach, self.n),
        )
        if r0 >= r1 or c0 >= c1:
            return image
        dx, dy = self.x[r0:r1, c0:c1] - at[0], self.y[r0:r1, c0:c1] - at[1]
        along, over = dx * np.cos(heading) + dy * np.sin(heading), dy * np.cos(heading) - dx * np.sin(heading)
        inside = (np.abs(along) < length / 2) & (np.abs(over) < width / 2)
        part = image[r0:r1, c0:c1]
        if callable(value):
            part[inside] = value(along[inside] / length)
        else:
            part[inside] += share * (value - part[inside])
        return image


def _body(rng):
    """Brightness along a car: paint, with darker glass before and behind the roof."""
    paint = rng.choice(
        [rng.uniform(0.03, 0.09), rng.uniform(0.25, 0.6), rng.uniform(0.1, 0.25)], p=[0.4, 0.3, 0.3]
    )
    glass = rng.uniform(0.04, 0.12)
    return lambda t: np.where((np.abs(t - 0.18) < 0.07) | (np.abs(t + 0.3) < 0.05), glass, paint)


def painted(
    name: str, seed: int, gsd_m: float = 1.0, count: int = 16, size_m: float = 400.0,
    tall_m: float = 20.0, angle_rate: float = 0.02, shadow_m: float = 0.9, wear: Wear | None = None,
) -> Sequence:  # fmt: skip
    """A painted scene.

    Parameters
    ----------
    name, seed
        Of the scene.
    gsd_m, count, size_m
        Side of a pixel, number of frames, side of the scene.
    tall_m, angle_rate
        Mean height of buildings [m], and how fast the line of sight turns [rad/s].
    shadow_m
        How far the middle of a vehicle's shadow lies from the vehicle's; beyond 1 m it is darker. [m]
    wear
        What happens to the frames.
    """
    rng = np.random.default_rng(seed)
    town = _Town(size_m, gsd_m, rng, tall_m)
    times = np.arange(count) / RATE_HZ
    cars, following = [], 0
    for lane, headway in town.lanes:
        for k, (place, speed) in enumerate(driven := _drive(lane, times, headway, rng)):
            where, heading = lane.at(place)
            cars += [(k, following + j, *where[j], heading[j], speed[j]) for j in range(len(place))]
        following += max(len(p) for p, _ in driven)
    looks = {i: (_body(rng), rng.uniform(3.8, 5.2), rng.uniform(1.7, 2.0)) for i in range(following)}
    for i in rng.choice(following, following // 12, replace=False):
        looks[int(i)] = (_body(rng), rng.uniform(8, 13), 2.5)
    sun, view = rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
    shadow, sight = np.array([np.cos(sun), np.sin(sun)]), np.array([np.cos(view), np.sin(view)])
    still = town.ground.copy()
    for crown, at, half, height, _, _ in town.tops:
        town.paint(
            still, np.array(at) + 0.5 * shadow * height, 0.0 if crown else town.turn, 2 * half, 0.05, 0.6
        )
    frames, rows = [], []
    for k in range(count):
        image = still.copy()
        mine = [c for c in cars if c[0] == k]
        for _, i, e, n, h, _ in mine:
            _, length, width = looks[i]
            for part in np.linspace(min(0.9, shadow_m), shadow_m, 1 + int(shadow_m)):
                town.paint(image, np.array([e, n]) + part * shadow, h, (length, width), 0.05, 0.5)
        for _, i, e, n, h, _ in mine:
            body, length, width = looks[i]
            town.paint(image, np.array([e, n]), h, (length, width), body)
        covered = np.zeros(image.shape)
        moved = sight * angle_rate * (times[k] - times[count // 2])
        for crown, at, half, height, bright, texture in town.tops:
            top = np.array(at) + height * moved
            if not crown:
                town.paint(image, np.array(at) + 0.5 * height * moved, town.turn, 2 * half, 0.6 * bright)
            own = np.random.default_rng(texture)
            for part in range(4):
                a = own.uniform(-0.4, 0.4, 2) * half
                b = bright * own.uniform(0.6, 1.4)
                box = 2 * half if part == 0 else half * own.uniform(0.4, 1.2, 2)
                jitter = rng.normal(0, 0.25, 2) if crown else 0.0
                town.paint(
                    image,
                    top + (a if part else 0) + jitter,
                    own.uniform(0, 3) if crown else town.turn,
                    box,
                    b,
                )
            town.paint(covered, top, 0.0 if crown else town.turn, 2 * half, 1.0)
        n = image.shape[0] // FINE
        frames.append(image[: n * FINE, : n * FINE].reshape(n, FINE, n, FINE).mean(axis=(1, 3)))
        for _, i, e, nn, h, v in mine:
            row, column = int(-nn / town.cell), int(e / town.cell)
            hidden = covered[row, column] if 0 <= row < town.n and 0 <= column < town.n else 1.0
            rows.append((times[k], i, e, nn, v * np.cos(h), v * np.sin(h), looks[i][1], 1.0 - hidden))
    names = [
        "time_s",
        "vehicle_id",
        "east_m",
        "north_m",
        "east_speed_m_s",
        "north_speed_m_s",
        "length_m",
        "visible_fraction",
    ]
    counts = worn(np.stack(frames), gsd_m, wear or Wear(), rng)
    return Sequence(name, times, counts, gsd_m, pd.DataFrame(rows, columns=names))
