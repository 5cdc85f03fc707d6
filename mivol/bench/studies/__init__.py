"""The studies: each module here is one, found by its name and run by ``mivol bench NAME``."""
