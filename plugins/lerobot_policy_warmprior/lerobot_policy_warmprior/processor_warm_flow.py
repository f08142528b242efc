"""Normalisation of states and actions by LeRobot's own steps, between raw units and those of the policy."""
