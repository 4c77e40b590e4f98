"""Clouds as the filter's later passes see them: what is left of noise there is smooth, which drawn noise never is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import nn

from straightpcf.model.normalize import CloudFrame, patch_scales
from straightpcf.model.patches import PATCH_SIZE
from straightpcf.model.train.archive import by_stem, opened, read_array, split_name
from straightpcf.model.train.data import (
    REACH,
    SCALES,
    TOUCH_UNTIL,
    Patch,
    PatchSource,
    Surface,
    near_first,
)
from straightpcf.points.errors import InvalidOptions, MalformedFile

__all__ = ["SHORTEST", "PassedCloud", "PassedClouds", "training_patches"]

SHORTEST = 2 * (1 - TOUCH_UNTIL)  # d below which a patch is as good as clean
_RECORDED = "<archive>/<shape>/<number>/xyz"  # or /frame


@dataclass(frozen=True)
class PassedCloud:
    """Hold a cloud (N, 3) in the frame that a later pass shows it in, and the surface, in the clean cloud's own."""

    xyz: npt.NDArray[np.float64]
    tree: cKDTree
    frame: CloudFrame
    surface: Surface


def training_patches(data: Sequence[Path], passed: Sequence[Path], distance: nn.Module) -> PatchSource:
    """Read the training clouds of the archives `data`, and those after passes of the archives `passed`."""
    source = PatchSource.read(*data)
    if passed:
        source.passed = PassedClouds(passed, data, distance, known=source.by_name)
    return source


class PassedClouds:
    """Draw patches of recorded clouds, each led to the surface by the way that the DistanceModule says it has to go."""

    def __init__(
        self,
        paths: Sequence[Path],
        data: Sequence[Path],
        distance: nn.Module,
        *,
        known: Mapping[tuple[Path, str], Surface] | None = None,
    ) -> None:
        """Read what `write_passed` wrote of the shapes of the archives `data`; raises InvalidOptions where one lacks,
        MalformedFile.

        distance: (B, PATCH_SIZE, 3) float32 patches -> (B, 1); it is asked without a gradient. known: surfaces of
        shapes by archive and name, so that their normals are computed once.
        """
        archives = by_stem(data)
        surfaces: dict[tuple[str, str], Surface] = {}
        self.clouds: list[PassedCloud] = []
        for path in paths:
            with opened(path) as recorded:
                for name in recorded.files:
                    archive, shape, number, what = split_name(name, path, rule=_RECORDED)
                    if what == "frame":
                        continue
                    if (frame_name := f"{archive}/{shape}/{number}/frame") not in recorded:
                        raise MalformedFile(f"{path} has {name[:80]}, and no {frame_name[:80]}")
                    if archive not in archives:
                        raise InvalidOptions(f"{path} has clouds of {archive}.npz, which is not among the data")
                    if (archive, shape) not in surfaces:
                        found = (known or {}).get((archives[archive], shape))
                        surfaces[archive, shape] = found or _surface(archives[archive], shape)
                    xyz = read_array(recorded, name, path).astype(np.float64)
                    *centre, radius = read_array(recorded, frame_name, path).tolist()
                    frame = CloudFrame(np.array(centre), radius)
                    self.clouds.append(PassedCloud(xyz, cKDTree(xyz), frame, surfaces[archive, shape]))
        if not self.clouds:
            raise InvalidOptions(f"no cloud after a pass is in {', '.join(map(str, paths)) or 'no file'}")
        self.distance = distance

    def __len__(self) -> int:
        return len(self.clouds)

    @torch.no_grad()
    def patch(self, rng: np.random.Generator) -> Patch:
        """Draw a patch as `PatchSource` does: its points are to go straight to the surface, nowhere along it.

        Where along the surface a point came from is not to be seen any more, and the loss does not ask for it.
        """
        cloud = self.clouds[rng.integers(len(self.clouds))]
        origin = cloud.xyz[rng.integers(len(cloud.xyz))]
        reach, near = cloud.tree.query(origin, k=PATCH_SIZE)
        scale = rng.uniform(*SCALES) * patch_scales(reach[-1:], scene=False)[0]
        transform = scale * np.asarray(Rotation.random(random_state=rng).as_matrix())
        here = cloud.xyz[near]
        shown = torch.from_numpy(((here - origin) @ transform).astype(np.float32))
        time = 1 - max(float(self.distance(shown[None])), SHORTEST)
        here = here[near_first(rng)]
        places = here * cloud.frame.radius + cloud.frame.centre
        clean = cloud.frame.enter(cloud.surface.touching(places, places))
        seed = origin * cloud.frame.radius + cloud.frame.centre
        around, normals = cloud.surface.around(seed, REACH * PATCH_SIZE / len(cloud.xyz))
        noisy = (here - time * clean) / (1 - time)
        parts = [(points - origin) @ transform for points in (noisy, clean, here, cloud.frame.enter(around))]
        when, passed = np.array([[time]]), np.array([[1.0]])
        return parts[0], parts[1], when, parts[2], parts[3], normals @ transform / scale, passed


def _surface(archive: Path, shape: str) -> Surface:
    """Return the finest cloud of a shape with its normals, in its own coordinates."""
    with np.load(archive, allow_pickle=False) as file:
        clouds = {name.split("/")[1]: file[name] for name in file.files if name.startswith(f"{shape}/")}
    normals, surface, _ = (clouds.pop(beside, None) for beside in ("normals", "surface", "eye"))
    if not clouds:
        raise InvalidOptions(f"{archive} has no shape {shape}, of which there are clouds after a pass")
    return Surface.of(clouds.values(), normals, surface)
