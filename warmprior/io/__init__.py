"""Files that are never left damaged, optional packages, and what this machine has."""
