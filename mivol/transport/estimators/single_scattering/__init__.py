"""Single scattering in media along one segment of a path."""
