"""Geometric parameters of a machine from measured records."""

from ccnn_torch.identification.links import fit_links as fit_links
