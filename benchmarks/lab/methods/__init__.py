"""The methods that are compared by name: sources, couplings and interpolants of this and other papers."""
