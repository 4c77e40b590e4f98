"""The frames the filter works in: one for the cloud, in float64, and one scale for each patch, for the network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from straightpcf.model.distinct import box_of

__all__ = [
    "HIGH_NOISE",
    "LARGEST_RADIUS",
    "SMALLEST_RADIUS",
    "CloudFrame",
    "is_dense_object",
    "is_scene",
    "noise_in_radii",
    "parts_of",
    "patch_scales",
    "zoom_of",
    "zoom_of_each",
    "zoom_of_flat",
    "zoom_of_rest",
]

# Patch radii seen in training, in radii of the object's bounding sphere: the 1st percentile of punet_train.npz at 10K
# to 50K points, 0.13, at augmentation's smallest scale, and the 99th (docs/training-log.md, "The first run").
SMALLEST_RADIUS, LARGEST_RADIUS = 0.1, 0.58
_MEDIAN_RADIUS = 0.25  # their median
_FLAT_NOISE = 0.004  # the std that a flat patch's noise is brought to, within limits: see `zoom_of_flat`
# Patches of objects at 50K points have 0.127 and more, those of six real scans 0.07 and less (medians of a cloud).
_SCENE_RADIUS = 0.1
# Nine tenths of an object's points have patches up to 2.8 times as large as those of a tenth, also as scanners see it;
# of a room's, scanned from a place in it, 3.9 times and more, and few points are of anything but its walls.
_SCENE_SPREAD = 3.3
# Smaller ones may be those of an object with very many points, where nine tenths of them, taken evenly over the cloud,
# are not so many times as large as one tenth: 1.03 to 1.72 of dense objects, 1.87 and more of scenes with such patches.
_LEAST_OBJECT_RADIUS, _EVEN_RADII = 0.03, 1.8
# In the first pass an object is shown in such a size that its noise has this std, within limits: see `zoom_of`.
_SHOWN_NOISE, _SMALLEST_ZOOM = 0.03, 1.0
_LARGEST_SHOWN_NOISE = 0.044  # more is brought to this, below the least factor, too
# Noise above a fifth more than any in training leaves waves, longer than what d knows for noise: see `zoom_of_rest`.
HIGH_NOISE = 0.036
_WAVES_RATIO, _REST_NOISE, _SMALLEST_REST_ZOOM = 1.1, 0.013, 0.4
_LARGEST_ZOOM, _LARGEST_ZOOMED_RADIUS = 2.5, 0.65
# Of noise, in radii of a patch, for each part, and the range of these in which both 1 and 2 do: see `parts_of`. It
# begins earlier where noise is so large that an object cannot be shown larger for it (`zoom_of`).
_NOISE_PER_PART, _BOTH_RANGE = 0.062, (1.25, 1.75)
_UNZOOMED_NOISE, _UNZOOMED_BOTH_FROM = 0.9 * _SHOWN_NOISE, 1.0
_MOST_PARTS, _SMALLEST_PART = 6, 2000
# A surface that is nothing but bent (`model.bent`) is filtered in so many that noise is so large in a part's patches.
_NOISE_OF_BENT, _MOST_PARTS_OF_BENT = 0.045, 24
_BLOCK = 2**16  # rows whose distances are held at once


@dataclass(frozen=True)
class CloudFrame:
    """The cloud's own frame: bounding-box centre (3,) float64 and the largest distance from it, in the cloud's unit."""

    centre: npt.NDArray[np.float64]
    radius: float

    @classmethod
    def of(cls, xyz: npt.NDArray[np.float64]) -> CloudFrame:
        """Measure finite points (N, 3); the radius is 0 where they all coincide."""
        low, high = box_of(xyz)
        centre = low / 2 + high / 2  # halves first: the sum may overflow
        extent = float(max((high - centre).max(), (centre - low).max()))
        if extent == 0.0:
            return cls(centre, 0.0)
        blocks = (xyz[start : start + _BLOCK] for start in range(0, len(xyz), _BLOCK))
        return cls(centre, extent * max(float(np.linalg.norm((b - centre) / extent, axis=1).max()) for b in blocks))

    def enter(self, xyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return (N, 3) float64 positions in the unit ball."""
        out = xyz - self.centre
        out /= self.radius
        return out


def is_scene(low: float, middle: float, high: float) -> bool:
    """Say of a cloud, by the radii in the unit ball of the patches of its points, whether it is no object seen whole.

    low, middle, high: a tenth of the points, half and nine tenths have patches no larger. A street or a LiDAR frame has
    far smaller ones beside its bounding sphere than any in training, a room of few points some far larger than others.
    """
    return middle < _SCENE_RADIUS or high > _SCENE_SPREAD * low > 0


def is_dense_object(noise_std: float, radii: npt.NDArray[np.float64], count: int) -> bool:
    """Say of a cloud that `is_scene` takes for one whether it is an object all the same, to be filtered in parts.

    noise_std, radii: in the unit ball, radii of some patches that lie evenly over it; count: of its points. They lie as
    close all over an object, not in a scene. Where noise asks for no parts, what scenes have is as good for it
    (docs/filter.md, "The size in which a patch is shown").
    """
    low, high = np.quantile(radii, (0.1, 0.9))
    is_even = low >= _LEAST_OBJECT_RADIUS and high < _EVEN_RADII * low
    return bool(is_even) and parts_of(noise_std, radii, count) != (1,)


def zoom_of(
    noise_std: float,
    radii: npt.NDArray[np.float64],
    *,
    shown: float = _SHOWN_NOISE,
    smallest: float = _SMALLEST_ZOOM,
) -> float:
    """Return the factor by which the first pass shows an object larger, for noise and patch radii in the unit ball.

    shown: the std that its noise is brought to, where limits allow it; smallest: the least factor.
    Noise and thin walls look alike, and a patch alone does not tell how much noise its cloud has. With the noise of
    every cloud brought to about one size, all else in a patch tells which it is (docs/filter.md has the figures).
    More noise than the network bears is made less, and the object smaller with it.
    """
    largest = np.clip(_LARGEST_ZOOMED_RADIUS / np.median(radii), 1.0, _LARGEST_ZOOM)
    noise_std = max(noise_std, 1e-9)
    return float(np.clip(shown / noise_std, min(smallest, _LARGEST_SHOWN_NOISE / noise_std), largest))


def zoom_of_each(noise_stds: npt.NDArray[np.float64], zoom: float) -> npt.NDArray[np.float64]:
    """Return the factors by which the first pass shows patches of noise stds (M,) larger: as `zoom_of`, `zoom` at most.

    Where noise is not the same all over an object, its noisiest parts would be shown with more than the network bears.
    """
    return np.clip(_SHOWN_NOISE / np.maximum(noise_stds, 1e-9), _SMALLEST_ZOOM, zoom)


def zoom_of_flat(noise_stds: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the factors, 1 at most, by which a scene's flat patches are shown smaller: (M,), for noise stds (M,).

    noise_stds: in the frame in which they have the usual size. What is flat but for its noise has nothing to lose, and
    the smaller its noise is shown the less of it the network takes for shape (docs/filter.md has the figures). They
    get no smaller than any patch in training.
    """
    return np.clip(_FLAT_NOISE / np.maximum(noise_stds, 1e-9), SMALLEST_RADIUS / _MEDIAN_RADIUS, 1.0)


def zoom_of_rest(noise_std: float, at_half_size: float) -> float:
    """Return the factor by which a later pass shows an object smaller, of which the first found more than HIGH_NOISE.

    noise_std: read of it as it is; at_half_size: of a quarter of its points, shown at half their size. Where more is
    seen there, what is left is longer than noise, and is brought to a size at which it looks like noise.
    """
    if at_half_size < _WAVES_RATIO * noise_std:
        return 1.0
    return float(np.clip(_REST_NOISE / max(at_half_size, 1e-9), _SMALLEST_REST_ZOOM, 1.0))


def noise_in_radii(noise_std: float, radii: npt.NDArray[np.float64]) -> float:
    """Return noise in radii of the median patch, both in one unit."""
    return noise_std / max(float(np.median(radii)), 1e-9)


def parts_of(noise_std: float, radii: npt.NDArray[np.float64], count: int, *, bent: bool = False) -> tuple[int, ...]:
    """Return in how many parts a pass filters `count` points, each by itself: (1,) where patches reach far enough.

    (1, 2): as a whole and in two parts, and takes the mean of both, which on the border between the two is better than
    either: where one takes walls for noise, the other does not, and the other way round.

    noise_std, radii: in the unit ball, radii of some patches of the whole cloud. A patch is the 1000 nearest points,
    however dense the cloud: where noise is as large as a patch, no network can tell where the surface is. A part of m
    has patches of sqrt(m) times the radius, at the same cost (docs/filter.md, "Parts").

    bent: whether the surface is nothing but bent: larger patches join nothing, and leave no layers.
    """
    in_radii = noise_in_radii(noise_std, radii)
    most = max(1, min(_MOST_PARTS_OF_BENT if bent else _MOST_PARTS, count // _SMALLEST_PART))
    if bent:
        return (max(1, min(round((in_radii / _NOISE_OF_BENT) ** 2), most)),)
    wanted = in_radii / _NOISE_PER_PART
    lowest = _BOTH_RANGE[0] if noise_std < _UNZOOMED_NOISE else _UNZOOMED_BOTH_FROM
    if lowest <= wanted < _BOTH_RANGE[1] and most > 1:
        return (1, 2)
    return (max(1, min(round(wanted), most)),)


def patch_scales(
    radii: npt.NDArray[np.float64], *, scene: bool, zoom: npt.NDArray[np.float64] | float = 1.0
) -> npt.NDArray[np.float64]:
    """Return the factor that brings each patch of the unit-ball cloud to a size the network knows, (M,) float64.

    Patches of an object sampled like the training clouds are shown `zoom` times their size: at 1 this is the paper's
    frame. Those of a scene are brought to the usual size, or keep a larger one (docs/filter.md says why not to the
    nearest that was seen). Patches that would be smaller or larger than any in training are brought to these limits,
    the upper one zoomed. One of radius 0 keeps the factor 1.
    """
    largest = np.maximum(1.0, zoom) * LARGEST_RADIUS
    wanted = np.clip(zoom * radii, _MEDIAN_RADIUS if scene else SMALLEST_RADIUS, largest)
    return np.where(radii > 0, wanted / np.where(radii > 0, radii, 1.0), 1.0)
