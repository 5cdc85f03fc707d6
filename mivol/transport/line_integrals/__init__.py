"""Emission-absorption integrals along a ray, composited from back to front: emission, radiance fields, expected depth, AOVs."""
