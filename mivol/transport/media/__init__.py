"""Participating media: coefficients at a point, extinction along a ray, and the order of media along it."""
