"""Formats of demonstrations: robomimic's HDF5 files, LeRobotDatasets and Minari datasets."""
