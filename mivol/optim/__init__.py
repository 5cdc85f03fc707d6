"""Change the field until it explains what was seen."""
