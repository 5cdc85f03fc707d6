"""Paths that scatter any number of times: free flights to collisions, and their derivatives."""
