"""Fits of scenes to images rendered by Mitsuba's integrators."""
