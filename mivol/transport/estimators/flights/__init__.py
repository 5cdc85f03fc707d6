"""Free flights of paths that scatter any number of times, and their derivatives."""
