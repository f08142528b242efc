"""What is measured on policies beside their success, a clock, and intervals."""
