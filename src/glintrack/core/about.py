"""The program's version, and how to cite it."""

from importlib.metadata import version

VERSION = version("glintrack")
_BIBTEX = """\
@software{{glintrack,
  title   = {{glintrack: an open simulator of imaging sensors and vehicle tracking}},
  author  = {{{{The glintrack authors}}}},
  version = {{{version}}},
  license = {{BSD-3-Clause}}
}}
@inproceedings{{presnar2010,
  title     = {{Dynamic scene generation, multimodal sensor design, and target tracking demonstration for
               hyperspectral/polarimetric performance-driven sensing}},
  author    = {{Presnar, Michael D. and Raisanen, Alan D. and Pogorzala, David R. and Kerekes, John P. and
               Rice, Andrew C.}},
  booktitle = {{Proc. SPIE 7672: Polarization: Measurement, Analysis, and Remote Sensing IX}},
  pages     = {{76720T}},
  year      = {{2010}},
  doi       = {{10.1117/12.849469}}
}}
"""


def citation() -> str:
    """What to cite, as BibTeX: this version of the program, and the paper whose chain it follows."""
    return _BIBTEX.format(version=VERSION)
