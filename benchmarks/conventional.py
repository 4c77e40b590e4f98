"""A conventional filter to compare with: CGAL's jet smoothing, each point onto a quadric fitted to its neighbours."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["JETS", "check_jet", "jet_smooth"]

Floats = npt.NDArray[np.float64]

# (neighbours, passes) by noise level in unit-sphere radii: the best CD on the held-out training shapes at 10K, of
# 24, 48, 72 neighbours and 1 to 4 passes. It is told the noise; "auto" is not.
JETS = {0.01: (24, 2), 0.02: (24, 4), 0.03: (48, 2)}


def check_jet() -> None:
    """End in one line where CGAL is not here, before the work of other models is done and lost."""
    try:
        from CGAL import CGAL_Kernel, CGAL_Point_set_3, CGAL_Point_set_processing_3  # noqa: F401 - whether they load
    except ImportError as exc:
        raise SystemExit("--model jet needs CGAL's Python package: pip install 'straightpcf[benchmarks]'") from exc


def jet_smooth(cloud: Floats, noise: float) -> tuple[Floats, int]:
    """Smooth (N, 3) points of known noise level (Cazals and Pouget 2005, as in CGAL 6); return them and the passes."""
    from CGAL.CGAL_Kernel import Point_3
    from CGAL.CGAL_Point_set_3 import Point_set_3
    from CGAL.CGAL_Point_set_processing_3 import jet_smooth_point_set

    neighbours, passes = JETS[min(JETS, key=lambda level: abs(level - noise))]
    points = Point_set_3()
    for point in cloud.tolist():
        points.insert(Point_3(*point))
    for _ in range(passes):
        jet_smooth_point_set(points, neighbours)
    return np.array([[point.x(), point.y(), point.z()] for point in points.points()]), passes
