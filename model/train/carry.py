"""Training clouds after a pass of the filter: what its later passes see, and noise drawn afresh never looks like."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from straightpcf.model.filter import Filter
from straightpcf.model.normalize import CloudFrame
from straightpcf.model.train.data import held_out_shapes
from straightpcf.points.options import DenoiseOptions

__all__ = ["carry"]


def carry(
    owner: Filter,
    data: Path,
    out: Path,
    *,
    noise_stds: Sequence[float],
    points: Sequence[int],
    seed: int = 0,
    on_progress: Callable[[float], None] | None = None,
) -> int:
    """Add noise to the training shapes' clouds of so many points, filter them once, write them to `out` and count them.

    data: clean clouds named `<shape>/<resolution>`, (N, 3); out: `<shape>/<resolution>/<number>`, (N, 3) float32 in the
    same frame and order, one for each of noise_stds (in radii of the bounding sphere).
    """
    rng = np.random.default_rng(seed)
    after: dict[str, npt.NDArray[np.float32]] = {}
    with np.load(data, allow_pickle=False) as archive:
        held_out = held_out_shapes(archive.files)
        names = [name for name in archive.files if name.split("/")[0] not in held_out]
        names = [name for name in names if archive[name].shape[0] in points]
        for done, name in enumerate(names):
            clean = archive[name].astype(np.float64)
            radius = CloudFrame.of(clean).radius
            for number, noise_std in enumerate(noise_stds):
                noisy = clean + noise_std * radius * rng.standard_normal(clean.shape)
                filtered = owner.denoise(noisy, DenoiseOptions(iterations=1)).xyz
                after[f"{name}/{number}"] = filtered.astype(np.float32)
            if on_progress is not None:
                on_progress((done + 1) / len(names))
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savez(out, **after)  # type: ignore[arg-type]
    return len(after)
