"""What may come of reading a damaged file: a value that is finite, or one short sentence."""

import dataclasses
import math
import unicodedata
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from pydantic import BaseModel

from glintrack.io.untrusted import plain
from tests.fuzz.readers import Reader

LONGEST_MESSAGE = 2500
LARGEST = 1e15  # nothing that a case describes is larger


def judged(reader: Reader, path: Path) -> str:
    """``read``, ``refused``, or what is wrong: ``traceback: …``, ``message: …`` or ``nonsense: …``."""
    try:
        value = reader.read(path)
    except ValueError as error:
        fault = message_fault(str(error))
        return f"message: {fault}" if fault else "refused"
    except Exception as error:
        return f"traceback: {type(error).__name__}: {str(error)[:120]!r}"
    fault = nonsense_in(value, reader.nan_means_none)
    return f"nonsense: {fault}" if fault else "read"


def message_fault(message: str) -> str:
    """What a refusal's sentence lacks; the program escapes control codes where it prints it."""
    if not message.strip():
        return "an empty message"
    shown = plain(message)  # as the program shows it
    if len(shown) > LONGEST_MESSAGE or has_control_codes(shown):
        return f"{len(shown)} characters, or control codes among them"
    return "" if "must" in message else f"no requirement in {message[:160]!r}"


def fault_of_call(code: int, out: str, err: str) -> str:
    """What is wrong with how a call of the program ended; empty if nothing is."""
    said = f"{out}\n{err}"
    if "Traceback (most recent call last)" in said:
        return f"traceback: {err.strip().splitlines()[-1][:200]}"
    if has_control_codes(said.replace("\r", "").replace("\t", "")):
        return "control codes"
    if code == 0:
        return ""
    if code != 2:
        return f"exit {code}: {err.strip()[-200:]}"
    if len(err) > LONGEST_MESSAGE:
        return f"{len(err)} characters of message"
    told = "glintrack: " in err and any(word in err for word in (" must ", "output", ": /"))
    usage = err.startswith("Usage: ")
    return "" if told or usage else f"no sentence: {err[-200:]!r}"


def has_control_codes(text: str) -> bool:
    """Whether a terminal would do more than show a text."""
    return any(unicodedata.category(c) in ("Cc", "Cf", "Cs") and c != "\n" for c in text)


def nonsense_in(value: Any, nan_means_none: bool, depth: int = 0) -> str:
    """The first number in a value that is not finite or too large for anything; empty if there is none."""
    if isinstance(value, float):
        bad = math.isinf(value) or abs(value) > LARGEST or (math.isnan(value) and not nan_means_none)
        return f"{value}" if bad else ""
    if isinstance(value, np.ndarray):
        return _in_array(value, nan_means_none)
    if isinstance(value, (xr.Dataset, xr.DataArray)):
        parts = value.variables.values() if isinstance(value, xr.Dataset) else [value]
        return next(filter(None, (_in_array(v.values, nan_means_none) for v in parts)), "")
    if depth > 6:
        return ""
    if isinstance(value, BaseModel):
        inner = [getattr(value, name) for name in type(value).model_fields]
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        inner = [getattr(value, field.name) for field in dataclasses.fields(value)]
    elif isinstance(value, dict):
        inner = list(value.values())
    elif isinstance(value, (tuple, list)):
        inner = list(value)[:1000]
    else:
        return ""
    return next(filter(None, (nonsense_in(v, nan_means_none, depth + 1) for v in inner)), "")


def _in_array(values: np.ndarray, nan_means_none: bool) -> str:
    if values.dtype.kind not in "fc" or not values.size:
        return ""
    bad = np.isinf(values) if nan_means_none else ~(np.abs(values) <= LARGEST)
    return f"{values[bad].flat[0]} in an array" if bad.any() else ""
