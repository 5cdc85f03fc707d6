"""Light from emitters and emitting media at a vertex of a path."""
