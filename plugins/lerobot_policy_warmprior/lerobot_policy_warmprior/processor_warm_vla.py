"""The policies' own processors: the source is in the units that they make."""
