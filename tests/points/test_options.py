"""Options of any type and size are taken or refused by name."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from straightpcf.points.errors import InvalidOptions
from straightpcf.points.options import DenoiseOptions


@pytest.mark.parametrize("strength", [10**400, -(10**400), float("nan"), float("inf"), True, False, "1", 1j])
def test_a_strength_that_is_no_share_is_refused_by_name(strength: Any) -> None:
    with pytest.raises(InvalidOptions, match=r"strength is .*; it must be in 0\.\.1"):
        DenoiseOptions(strength=strength)


@pytest.mark.parametrize("field", ["seed", "iterations", "strength"])
def test_a_whole_number_of_thousands_of_digits_is_refused_by_name(field: str) -> None:
    with pytest.raises(InvalidOptions, match=rf"{field} is a int of too many digits; it must be"):
        DenoiseOptions(**{field: 10**5000})


@pytest.mark.parametrize("strength", [0, 1, Fraction(1, 2), np.float32(0.5), 0.25])
def test_a_share_of_any_kind_of_number_becomes_a_float(strength: Any) -> None:
    assert DenoiseOptions(strength=strength).strength == strength
    assert type(DenoiseOptions(strength=strength).strength) is float


@pytest.mark.parametrize("text", ["1_0", "\u0661", "\uff11", "1 0", "0x1", "", "1\u2003", "nan", "infinity"])
@pytest.mark.parametrize("field", ["seed", "iterations", "strength"])
def test_a_text_that_is_a_number_to_python_alone_is_refused(field: str, text: str) -> None:
    with pytest.raises(InvalidOptions, match=rf"{field} is .*; it must be"):
        DenoiseOptions.parse(**{field: text})


@pytest.mark.parametrize("text", ["1", "+1", " 1 ", "01"])
def test_plain_digits_are_taken(text: str) -> None:
    assert DenoiseOptions.parse(seed=text, iterations=text, strength=text) == DenoiseOptions(seed=1, iterations=1)
    for share in ("5e-1", ".5", "0.5", "+0.5E0"):
        assert DenoiseOptions.parse(strength=share).strength == 0.5
