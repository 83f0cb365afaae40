"""From a triplane sequence to low-rank and sparse parts, and from these to planes."""

from xplanes.decomposition.conversion import space_planes, time_planes
from xplanes.decomposition.rpca import Decomposition, RobustPCA, decompose, robust_pca
from xplanes.decomposition.sparse_loss import sparse_product_loss, unexplained_energy

__all__ = [
    "Decomposition",
    "RobustPCA",
    "decompose",
    "robust_pca",
    "space_planes",
    "sparse_product_loss",
    "time_planes",
    "unexplained_energy",
]
