"""Jobs that train, measure, play and film policies, and agents in their source space."""
