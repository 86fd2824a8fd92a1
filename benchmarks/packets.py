"""How long a frame's rays take in packets of each width, on processors with wider and narrower vectors.

``python benchmarks/packets.py`` holds Embree to the instructions of an older processor, and times the rays of
look, of mirrors and to the sun of one frame of `quickstart`, each met surface resolved, on one thread and
with probes known: wall time, the best of three. The width that glintrack takes by itself is marked.
"""

import os
import time
from ctypes import CDLL

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the program does, before NumPy is loaded

import numba as nb

from glintrack.case.build import build_scenario
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.render.rays import embree
from glintrack.render.rays.embree import WIDTHS, EmbreeTracer

INSTRUCTIONS = "avx512", "avx2", "sse2"  # of newer servers; of most machines; of old ones


def main() -> None:
    """Trace, and print."""
    nb.set_num_threads(1)
    print("| instructions | " + " | ".join(f"{lanes} rays" for lanes in WIDTHS) + " |")
    print("| --- |" + " --- |" * len(WIDTHS))
    load = embree.load_library
    for isa in INSTRUCTIONS:
        embree.load_library = lambda isa=isa: held_to(isa, load())
        scenario = build_scenario(Case.from_toml(find_case("quickstart")))
        observer, at, pose = scenario.observer, scenario.city.at(10.0), scenario.flight.pose(10.0)
        rays = observer.tracer.rays
        assert isinstance(rays, EmbreeTracer)
        own, cells = rays.lanes, []
        for lanes in WIDTHS:
            rays.lanes = lanes
            took = []
            for _ in range(4):  # the first finds probes
                begun = time.perf_counter()
                observer.trace(at, pose)
                took.append(time.perf_counter() - begun)
            cells.append(f"{min(took[1:]):.2f} s" + (" (taken)" if lanes == own else ""))
        print(f"| {isa} | " + " | ".join(cells) + " |")


def held_to(isa: str, library: CDLL) -> CDLL:
    """Embree whose devices use no other instructions."""
    new = library.rtcNewDevice
    library.rtcNewDevice = lambda settings: new(settings + f",isa={isa}".encode())
    return library


if __name__ == "__main__":
    main()
