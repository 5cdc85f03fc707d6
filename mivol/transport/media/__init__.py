"""Participating media: extinction along rays and at points, and the order of media along a ray."""
