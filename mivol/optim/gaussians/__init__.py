"""Fits of Gaussians to photographs."""
