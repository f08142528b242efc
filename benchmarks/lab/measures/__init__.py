"""This room measures policies beside their success, and has intervals."""
