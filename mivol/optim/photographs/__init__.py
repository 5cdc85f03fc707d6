"""Fits of radiance fields to photographs."""
