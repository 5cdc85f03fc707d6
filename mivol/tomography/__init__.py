"""Computed tomography: geometries, the matched projector pair, filtered back-projection, phantoms, and measured projections."""
