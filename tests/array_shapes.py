"""Run-time check of the arrays' shapes and kinds in annotated signatures, switched on by tests/__init__.py.

Only array annotations (jaxtyping) are checked: a general checker refuses the tuples that numpy's ArrayLike
admits, and pre-empts the ValueErrors that users are to see.
"""

import functools
import inspect
import types
import typing

from jaxtyping import AbstractArray

# Modules of glintrack whose functions are all plain Python: numba cannot compile a wrapped function.
PLAIN_MODULES = (
    "atmosphere",
    "camera",
    "case.design",
    "flight",
    "io",
    "metrics",
    "core.records",
    "scene",
    "core.schema",
    "sensor.design",
    "sensor.fixed_pattern",
    "sensor.exposure",
    "sensor.sensor",
    "sensor.layouts",
    "sensor.navigation",
    "sensor.wavefront",
    "sensor.polarizer",
    "sensor.response",
    "sensor.spectrometer",
    "loop",
    "core.spectral",
    "track.design",
    "track.identity",
    "track.queries",
    "track.tracker",
    "results.figures.tracks",
)


def check(function):
    """Decorate a function so that arrays that do not fit their annotations raise TypeError."""
    signature = inspect.signature(function)
    names = tuple(signature.parameters)
    arrays = {p.name: p.annotation for p in signature.parameters.values() if _holds_array(p.annotation)}
    returned = signature.return_annotation
    if not arrays and not _holds_array(returned):
        return function

    @functools.wraps(function)
    def checked(*args, **kwargs):
        for name, value in (*zip(names, args, strict=False), *kwargs.items()):
            if name in arrays:
                _refuse_misfit(value, arrays[name], name)
        result = function(*args, **kwargs)
        _refuse_misfit(result, returned, "result")
        return result

    return checked


def _holds_array(annotation) -> bool:
    if isinstance(annotation, type) and issubclass(annotation, AbstractArray):
        return True
    return any(map(_holds_array, typing.get_args(annotation)))


def _refuse_misfit(value, annotation, name: str) -> None:
    if not _fits(value, annotation):
        came = f"{getattr(value, 'dtype', type(value).__name__)}{list(getattr(value, 'shape', ()))}"
        raise TypeError(f"`{name}` must be {annotation}; got {came}")


def _fits(value, annotation) -> bool:
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if isinstance(annotation, type) and issubclass(annotation, AbstractArray):
        return isinstance(value, annotation)
    if origin in (typing.Union, types.UnionType):
        others = [a for a in arguments if not (isinstance(a, type) and issubclass(a, AbstractArray))]
        return len(others) == len(arguments) or value is None or any(_fits(value, a) for a in arguments)
    if origin is tuple and isinstance(value, tuple) and len(arguments) == len(value):
        return all(_fits(v, a) for v, a in zip(value, arguments, strict=True))
    return True
