"""Light from emitters, and from media that emit, at a vertex of a path."""
