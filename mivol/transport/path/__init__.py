"""Paths from the camera through media and surfaces, and the film that averages their radiance."""
