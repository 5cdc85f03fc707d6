"""Optimization: fit a field to images, photographs or projections."""
