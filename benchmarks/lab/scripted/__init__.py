"""Scripted experts that generate demonstrations where no official data are at hand."""
