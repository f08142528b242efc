"""This room measures policies beside their success, and has a clock and intervals."""
