"""Tasks, and the sources of their demonstrations: official files, scripted experts, rendered images."""
