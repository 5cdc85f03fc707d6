"""Geometry only: the cells that a ray crosses, interpolation and quadrature in one cell, ray spawning, random numbers."""
