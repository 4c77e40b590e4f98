"""What is read of a cloud before a pass, and of the patches of a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from straightpcf.model.patches import Patches
from straightpcf.model.spacing import Sampling
from straightpcf.model.views import View

__all__ = ["Reading", "ScenePatches"]

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Reading:
    """What was read of a cloud before a pass.

    distance: the DistanceModule's median over some patches; noise_std: in the unit ball; scene: whether the cloud is no
    object seen whole, a raster among them; sampling: how its points lie; zoom: the factor by which the pass shows an
    object larger; parts: in how many it filters it (`parts_of`); noise_in_radii: an object's noise std in radii of its
    patches, before the first pass (a scene's are shown in sizes of their own, and d says as much); known_distances:
    what the DistanceModule said of patches of that pass, by number; noise_of_most: the noise std that four fifths of a
    scene's points have, or less; most_on_surfaces: what is believed of any place of a scene by a few neighbours, before
    the first pass; high_noise: whether an object has more noise than HIGH_NOISE, before the first pass;
    uneven: whether that pass shows no patch larger than the noise in it asks for; height_axis: that of the heights of a
    raster, None of any other cloud; view: the place that the cloud was seen from, before the first pass, None where its
    points are no raster of beams; probes: the patches that were read; thickness: of the surface that a pass has left of
    dense points, the median of the std of each point's nearest across their plane by the lesser one along it.
    """

    distance: float
    noise_std: float
    scene: bool
    sampling: Sampling
    zoom: float = 1.0
    parts: tuple[int, ...] = (1,)
    noise_in_radii: float = 0.0
    known_distances: Mapping[int, float] = field(default_factory=dict)
    noise_of_most: float = 0.0
    most_on_surfaces: float = np.inf
    high_noise: bool = False
    uneven: bool = False
    height_axis: int | None = None
    view: View | None = None
    probes: Patches | None = None
    thickness: float = 0.0


@dataclass(frozen=True)
class ScenePatches:
    """How a pass shows patches of a scene, and what was read of them so, all (M,).

    usual_distances: what the DistanceModule says of them in the usual size; scales, distances: in which size each is
    shown, and what it says of them there; noise_stds: the noise of each, in the unit ball; flat: whether that is all
    that keeps it from being flat.
    """

    usual_distances: Floats
    scales: Floats
    distances: Floats
    noise_stds: Floats
    flat: npt.NDArray[np.bool_]
