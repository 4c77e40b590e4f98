"""StraightPCF: hand it a noisy point cloud, get the same points back on the surface.

`straightpcf.model` is the filter (numpy and torch), `straightpcf.clients.sdk` talks to a running
server and needs no torch, `straightpcf.service` is that server, `straightpcf.points` is what a cloud
is in memory and on disk.
"""

__version__ = "0.1.0"
__all__ = ["__version__"]
