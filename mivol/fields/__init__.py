"""Extinction, albedo, emission and radiance as functions of position: on grids, as Gaussians, procedural."""
