"""Extinction, albedo, emission and radiance as functions of position: analytic, on grids, as Gaussians."""
