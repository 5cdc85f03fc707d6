"""A run as a function: an image, a fit of a scene, of photographs or of a scan, from its settings to its folder."""
