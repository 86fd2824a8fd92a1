"""The run-time check of array annotations is on, and can fail."""

import numpy as np
import pytest
from jaxtyping import Float, TypeCheckError

from glintrack.core.spectral import channel_weights
from tests.array_shapes import check

Array = np.ndarray


def test_the_hook_watches_the_package():
    with pytest.raises(TypeCheckError, match="responses"):
        channel_weights(np.linspace(0.4, 1.0, 7), np.ones((1, 6)))


def test_one_name_is_one_size():
    with pytest.raises(TypeCheckError):
        channel_weights(np.linspace(0.4, 1.0, 7), np.ones(7))


@pytest.mark.parametrize("value", [np.zeros(4), np.zeros((3, 3)), np.zeros(3, int), [0.0, 0.0, 0.0]])
def test_check_refuses_what_does_not_fit(value):
    @check
    def direction(v: Float[Array, "3"]) -> None:
        """Take a vector."""

    with pytest.raises(TypeError, match="`v` must be"):
        direction(value)


def test_check_looks_into_unions_tuples_and_results():
    @check
    def halves(v: Float[Array, "n"] | None, scale: float = 1) -> tuple[Float[Array, "n"], Float[Array, "2"]]:
        """Half of the answer is wrong for n ≠ 2."""
        return (v, v) if v is not None else (np.zeros(1), np.zeros(2))

    assert len(halves(None)) == 2 and len(halves(np.zeros(2), scale=2)) == 2
    with pytest.raises(TypeError, match="`result`"):
        halves(np.zeros(3))
    with pytest.raises(TypeError, match="`result`"):
        halves(np.zeros((2, 1)))
