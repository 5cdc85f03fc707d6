"""Sums along a ray from back to front: emission, radiance fields, expected depth, AOVs."""
