"""The colour of points, however a file says it, in the form that a new file of another format has for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["PACKED", "RGB", "are_shares", "in_8_bits", "in_16_bits", "packed", "unpacked"]

RGB = ("red", "green", "blue")
PACKED = ("rgb", "rgba")  # PCL's: the bytes of a 32 bit number, 0xAARRGGBB, often called a float
_NO_COLOUR = np.uint32(0x7FC00000)  # NaN, which PCL has for points that are not there
_TRIPLES = (RGB, ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))  # OpenSfM's and PMVS's
_ARRAYS = ("colors", "color", "colours", "colour", "rgb")  # (N, 3), as Open3D has it and NumPy's archives hold it
_SAME = 1e-3  # of a step of 1/255: what float32 rounds a share to
_Attributes = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class _Colour:
    """Hold (N, 3) uint8 or uint16, and the attributes that are not the colour, in their order."""

    rgb: npt.NDArray[Any]
    others: dict[str, npt.NDArray[Any]]

    @property
    def in_8_bits(self) -> npt.NDArray[np.uint8] | None:
        """Return (N, 3) uint8 where it says the same: low bytes repeat the high ones, are 0, or are all there is."""
        if self.rgb.dtype == np.uint8:
            return self.rgb
        if not (self.rgb % 257).any():
            return (self.rgb // 257).astype(np.uint8)
        if not (self.rgb & 255).any():
            return (self.rgb >> 8).astype(np.uint8)
        return self.rgb.astype(np.uint8) if not (self.rgb >> 8).any() else None

    def beside(self, rgb: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
        """Return all attributes, the colour as three of them."""
        return {**self.others, **dict(zip(RGB, rgb.T, strict=True))}


def in_8_bits(attributes: _Attributes) -> dict[str, npt.NDArray[Any]]:
    """Return attributes with the colour as red, green and blue: uint8 where that loses nothing, else uint16."""
    if (colour := _colour(attributes)) is None:
        return dict(attributes)
    short = colour.in_8_bits
    return colour.beside(colour.rgb if short is None else short)


def in_16_bits(attributes: _Attributes) -> dict[str, npt.NDArray[Any]]:
    """Return attributes with the colour as red, green and blue, uint16 of the whole range: 255 becomes 65535."""
    if (colour := _colour(attributes)) is None:
        return dict(attributes)
    is_short = colour.rgb.dtype == np.uint8
    return colour.beside(colour.rgb.astype(np.uint16) * 257 if is_short else colour.rgb)


def packed(attributes: _Attributes) -> dict[str, npt.NDArray[Any]]:
    """Return attributes with the colour as PCL's `rgb`, and as uint16 beside it where that holds more."""
    if (colour := _colour(attributes)) is None or "rgb" in colour.others:
        return dict(attributes)
    short = colour.in_8_bits
    red, green, blue = ((colour.rgb >> 8) if short is None else short).astype("<u4").T
    beside = colour.others if short is not None else colour.beside(colour.rgb)
    return {**beside, "rgb": (red << 16 | green << 8 | blue).view("<f4")}


def unpacked(attributes: _Attributes) -> dict[str, npt.NDArray[Any]]:
    """Return attributes with a packed colour, or one array, as red, green and blue; another one stays as it is."""
    together = {*PACKED} & {*attributes} or {*_ARRAYS} & {name.lower() for name in attributes}
    return in_8_bits(attributes) if together else dict(attributes)


def are_shares(numbers: npt.NDArray[np.float64]) -> bool:
    """Say whether (N, 3) numbers are whole shares of 255, and can be nothing else: some are no fifths, as 0.2 is."""
    shares = _shares(numbers)
    return shares is not None and bool((shares % 51).any())


def _colour(attributes: _Attributes) -> _Colour | None:
    """Find the colour; None where there is none, or not one alone."""
    called = {name.lower(): name for name in attributes}
    for three in _TRIPLES:
        names = [called[part] for part in three if part in called]
        rgb = _whole([attributes[name] for name in names]) if len(names) == 3 else None
        others = {name: values for name, values in attributes.items() if name not in names}
        if rgb is not None and not {*RGB} & {*others}:
            return _Colour(rgb, others)
    for name in (called[name] for name in _ARRAYS if name in called):
        others = {other: values for other, values in attributes.items() if other != name}
        if (rgb := _of_array(attributes[name])) is not None and not {*RGB} & {*others}:
            return _Colour(rgb, others)
    for name in PACKED:
        values = attributes.get(name)
        if values is not None and values.ndim == 1 and values.dtype.kind in "fiu" and values.dtype.itemsize == 4:
            others = {other: values for other, values in attributes.items() if other != name}
            return None if {*RGB} & {*others} else _of_packed(values, others)
    return None


def _whole(columns: Sequence[npt.NDArray[Any]]) -> npt.NDArray[Any] | None:
    """Return three columns of whole numbers, or shares of 255, as (N, 3) uint8 or, of larger ones, uint16."""
    if not all(values.ndim == 1 and values.dtype.kind in "fiu" for values in columns):
        return None
    kinds = {values.dtype.newbyteorder("=") for values in columns}
    if kinds in ({np.dtype(np.uint8)}, {np.dtype(np.uint16)}):
        return np.stack(columns, axis=1).astype(kinds.pop())
    with np.errstate(invalid="ignore"):  # a signalling NaN is no warning
        numbers = np.stack([values.astype(np.float64) for values in columns], axis=1)
    if not ((numbers >= 0) & (numbers < 2**16) & (numbers == np.rint(numbers))).all():
        return _shares(numbers) if are_shares(numbers) else None
    if numbers.max(initial=0) == 1 and any(kind.kind == "f" for kind in kinds):
        return None  # floats of 0 and 1 may as well be the whole range
    return numbers.astype(np.uint8 if (numbers < 256).all() else np.uint16)


def _of_array(values: npt.NDArray[Any]) -> npt.NDArray[Any] | None:
    """Return (N, 3) colours as uint8 or uint16; floats from 0 to 1 are shares of 255, where all are whole ones."""
    if values.ndim != 2 or values.shape[1] != 3:
        return None
    if values.dtype.kind == "f" and ((values >= 0) & (values <= 1)).all():
        return _shares(values.astype(np.float64))
    return _whole(list(values.T))


def _shares(numbers: npt.NDArray[np.float64]) -> npt.NDArray[np.uint8] | None:
    """Return numbers from 0 to 1 that are whole shares of 255 as these."""
    if not ((numbers >= 0) & (numbers <= 1)).all():
        return None
    shares = 255 * numbers
    return np.rint(shares).astype(np.uint8) if (np.abs(shares - np.rint(shares)) < _SAME).all() else None


def _of_packed(values: npt.NDArray[Any], others: dict[str, npt.NDArray[Any]]) -> _Colour | None:
    """Take (N,) numbers of 32 bits apart; the fourth byte is an attribute where it is not the same all over.

    None where another one is called as that would be: MeshLab's alpha, converted, stands beside bytes that say nothing.
    """
    words = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<"))).view("<u4")
    if values.dtype.kind == "f":
        words = np.where(words == _NO_COLOUR, 0, words)
    alpha, *parts = ((words >> shift & 255).astype(np.uint8) for shift in (24, 16, 8, 0))
    rgb = np.stack(parts, axis=1)
    if not alpha.any() or bool((alpha == 255).all()):
        return _Colour(rgb, others)
    return None if "alpha" in others else _Colour(rgb, {**others, "alpha": alpha})
