"""Line integrals measured from many sides: geometries, the matched projector pair, phantoms, and real projections."""
