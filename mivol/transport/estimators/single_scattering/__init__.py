"""Light that is scattered once in media, along one segment."""
