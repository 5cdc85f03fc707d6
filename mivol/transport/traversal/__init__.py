"""Geometry of rays in grids and boxes, with interpolation and quadrature in a cell, and random numbers for each lane."""
