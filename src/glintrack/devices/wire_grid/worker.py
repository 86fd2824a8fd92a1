"""A process that solves wavelengths of one pixel, started by `sweep`.

It reads the design as one line of JSON, then a wavelength and the wires' permittivity a line, and answers
each with a line. A process of its own holds NGSolve and OpenBLAS to one thread before they load, whatever the
caller has imported, and needs no guard in the caller's script.
"""

import json
import sys
from importlib.metadata import version

from glintrack.devices.wire_grid.design import WireGridDesign
from glintrack.devices.wire_grid.pixel_response import Pixel, measure


def main() -> None:
    """Answer requests until standard input ends."""
    design = WireGridDesign.model_validate_json(sys.stdin.readline())
    pixel, sizes = None, ()
    for line in sys.stdin:
        wavelength_um, real, imaginary = json.loads(line)
        needed = design.fem.air_element_at(wavelength_um), design.fem.wire_element_at(wavelength_um)
        if pixel is None or sizes != needed:
            pixel, sizes = Pixel.of(design, wavelength_um), needed
        row = measure(pixel, wavelength_um, complex(real, imaginary))
        about = {"ngsolve": version("ngsolve"), "elements": pixel.grid.mesh.ne}
        print(json.dumps({"wavelength_um": wavelength_um, **row, **about}), flush=True)


if __name__ == "__main__":
    main()
