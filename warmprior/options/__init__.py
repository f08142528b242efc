"""Dataclasses of what a user chooses, which are read, shown and checked without PyTorch."""
