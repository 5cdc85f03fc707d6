"""Experiments: an image, a fit of a scene, of photographs or of projections, from the settings to the run folder."""
