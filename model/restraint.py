"""How far the points of a scene may go: what would have to move much farther than its noise reaches is no noise."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from straightpcf.model.patches import Patches

__all__ = ["reaches", "restrained"]

# In noise stds: moves up to the first are made whole, from the last on none is (docs/training.md, "Scenes").
_WHOLE, _NONE = 3.0, 4.0
_SHEET = 1.3  # a patch is one sheet where its points lie so many of its noise stds from their plane, or nearer
_MOST = 3.0  # of the usual noise, what is believed of any sheet
_DOUBTFUL = 1.2  # of the usual noise; of what is no sheet and reads more, less is believed the more it reads


def reaches(
    here: npt.NDArray[np.float64], cut: Patches, noise: npt.NDArray[np.float64], usual: float
) -> npt.NDArray[np.float64]:
    """Return the noise std that is believed of each patch of points (N, 3): (M,), in their unit.

    noise: (M,), read of each patch; usual: of most points. The network takes a pole, a wire or a leaf for noise, and
    reads more of it there. So more than the usual is believed only of a patch whose noise is all that keeps it from
    being flat, as of the far wall in a depth camera's frame, and less than the usual of any other that reads far more.
    """
    thickness = np.array([_thickness(here[rows]) for rows in cut.index])
    doubt = np.minimum(1.0, _DOUBTFUL * usual / np.maximum(noise, 1e-300))
    return np.where(thickness < _SHEET * noise, np.clip(noise, usual, _MOST * usual), usual * doubt)


def restrained(
    moved: npt.NDArray[np.float64], step: npt.NDArray[np.float64], noise_std: float
) -> npt.NDArray[np.float64]:
    """Return a step (n, 3) of points that have moved by (n, 3) before, less of it the less it is believed.

    A redescending weight as of robust estimators, straight from 1 to 0 (Hampel's outer part).
    """
    distance = np.linalg.norm(moved + step, axis=1)
    weight = np.clip((_NONE - distance / max(noise_std, 1e-300)) / (_NONE - _WHOLE), 0.0, 1.0)
    out: npt.NDArray[np.float64] = step * weight[:, None]
    return out


def _thickness(points: npt.NDArray[np.float64]) -> float:
    """Return the rms distance of points (n, 3) from the plane that fits them best."""
    local = points - points.mean(axis=0)
    return float(np.sqrt(max(np.linalg.eigvalsh(local.T @ local)[0], 0.0) / len(points)))
