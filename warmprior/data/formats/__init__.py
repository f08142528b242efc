"""Formats of demonstrations: robomimic's HDF5 files, LeRobotDatasets and Minari datasets.

Each is a subclass of :class:`~warmprior.data.Demonstrations` in ``FORMATS`` (``warmprior/data/opening.py``).
"""
