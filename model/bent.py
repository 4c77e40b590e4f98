"""Objects that are nothing but a bent surface, such as open sheets: much noise is filtered in more parts there.

A part's patches reach farther. On a body they join what is apart; on a sheet there is nothing to join, and they tell it
better from its noise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from straightpcf.model.neighbourhoods import Nearest
from straightpcf.model.normalize import noise_in_radii, parts_of
from straightpcf.model.patches import Patches
from straightpcf.model.walls import LocalFit

__all__ = ["off_quadrics", "parts_of_object"]

Floats = npt.NDArray[np.float64]
Look = Callable[[int], tuple[Floats, Patches]]

# An object is nothing but bent where four in five of its patches, in which noise is so large in their radii, lie no
# farther from a quadric than so many noise stds, and half of a part's patches no farther than so many.
_BENT_WITHIN, _BENT_SHARE = 0.1, 0.8
_BENT_STDS, _PART_STDS = 1.25, 1.5
# With more noise than any in training a sheet ends in layers, which cost more than what larger patches take of a shape.
# So much is read of 4 % on sheets: somewhat less than there is. Of 3 % on a body up to 3.7 % is read, so that the first
# question is asked less strictly of more than that alone.
_LAYERS_NOISE, _LAYERS_PART_STDS = 0.0325, 2.5
_LOUD_NOISE, _LOUD_BENT_STDS = 0.038, 1.4
# From so much on walls are read as noise that are not, and then lie no farther from a quadric than that.
_MOST_NOISE = 0.055
# The kurtosis of what is off the quadric, in half of those patches: normal noise has 3, and somewhat less where a patch
# cuts it off; two walls closer than noise have less, and noise with long tails, which hides them from this, has more.
_LEAST_KURTOSIS, _MOST_KURTOSIS = 2.85, 3.3


def parts_of_object(noise_std: float, radii: Floats, count: int, look: Look) -> tuple[int, ...]:
    """Return in how many parts a pass filters an object of `count` points: as `parts_of`, more if it is only bent.

    noise_std, radii: as of that. look: returns one of so many parts of the points, (M, 3), and some of its patches.
    """
    usual, bent = (parts_of(noise_std, radii, count, bent=is_so) for is_so in (False, True))
    if bent <= usual[-1:] or noise_std > _MOST_NOISE:
        return usual
    bent_stds = _LOUD_BENT_STDS if noise_std > _LOUD_NOISE else _BENT_STDS
    part_stds = _LAYERS_PART_STDS if noise_std > _LAYERS_NOISE else _PART_STDS
    stds, kurtoses = off_quadrics(*look(max(1, round((noise_in_radii(noise_std, radii) / _BENT_WITHIN) ** 2))))
    if np.quantile(stds, _BENT_SHARE) > bent_stds * noise_std:
        return usual
    if not _LEAST_KURTOSIS < np.median(kurtoses) < _MOST_KURTOSIS:
        return usual
    of_parts, _ = off_quadrics(*look(bent[0]))
    return bent if np.median(of_parts) < part_stds * noise_std else usual


def off_quadrics(positions: Floats, patches: Patches) -> tuple[Floats, Floats]:
    """Return the std and the kurtosis, (M,) each, of what patches of (N, 3) points are off the best quadric."""
    near = Nearest(patches.radii[:, None], positions[patches.index]).first(patches.index.shape[1])
    along = near.along_axes()
    fit = LocalFit.of(along, near.radii)
    squares = np.square(fit.residuals(along[:, :, 0]))
    _, count, terms = fit.terms.shape
    stds = np.sqrt(squares.sum(axis=1) / max(count - terms, 1))
    return stds, np.square(squares).mean(axis=1) / np.maximum(np.square(squares.mean(axis=1)), 1e-300)
