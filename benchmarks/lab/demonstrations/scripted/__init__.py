"""Scripted experts that generate demonstrations in place of official ones."""
