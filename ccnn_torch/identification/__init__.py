"""Geometric parameters of a machine from measured records, and the correction that follows from them."""

from ccnn_torch.identification._geometric_deviation import GeometricDeviation as GeometricDeviation
from ccnn_torch.identification._links import fit_links as fit_links
