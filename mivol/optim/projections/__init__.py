"""Reconstruction of volumes from line integrals."""
