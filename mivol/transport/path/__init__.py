"""The walk of a path from the camera, the scores that it is told to, and the film."""
