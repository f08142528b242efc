"""Errors of runs, worker processes of this machine or of Ray, and the machine itself."""
